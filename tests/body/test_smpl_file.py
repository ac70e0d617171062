"""Model files: npz and pickles of the releases give the same body; other files are refused with a reason."""

import pickle
import sys
import types

import numpy as np
import pytest
import torch
from scipy.sparse import csc_matrix, csr_matrix

from pipeline.body.smpl import SmplBody
from pipeline.body.smpl_file import load_smpl, plain_array
from pipeline.core.errors import UserError
from tests.body.smpl_sample import file_contents, sample_arrays


class Chumpy:
    """Classes that pickle under chumpy's names until monkeypatch is undone; the package is not installed."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setitem(sys.modules, "chumpy", types.ModuleType("chumpy"))
        for module, name in (("chumpy.ch", "Ch"), ("chumpy.reordering", "Select")):
            made = types.ModuleType(module)
            setattr(made, name, type(name, (), {"__module__": module}))
            monkeypatch.setitem(sys.modules, module, made)

    def variable(self, array: np.ndarray) -> object:
        made = sys.modules["chumpy.ch"].Ch()
        made.__dict__.update(x=array, _dirty_vars=set(), _itr=None)
        return made

    def selection(self, of: object, rows: np.ndarray, shape: tuple[int, ...]) -> object:
        made = sys.modules["chumpy.reordering"].Select()
        made.__dict__.update(a=of, idxs=rows, preferred_shape=shape)
        return made


def write_pickle(path, contents: dict, protocol: int = 2):
    path.write_bytes(pickle.dumps(contents, protocol=protocol))
    return path


def assert_same(found: SmplBody, joint_count: int) -> None:
    expected = SmplBody(sample_arrays(joint_count))
    betas = torch.linspace(-1.0, 1.0, 10)
    for mine, true in zip(found.rest_pose(betas), expected.rest_pose(betas), strict=True):
        assert torch.allclose(mine, true, atol=1e-6)
    assert np.array_equal(found.parents, expected.parents)
    assert np.array_equal(found.faces, expected.faces)


@pytest.mark.parametrize("joint_count", [24, 52, 55])
def test_npz_gives_the_model(tmp_path, joint_count: int) -> None:
    path = tmp_path / "model.npz"
    extra = {"part2num": np.array({"head": 1}, dtype=object)}  # SMPL-X files hold pickled objects, which are not used
    np.savez(path, **file_contents(sample_arrays(joint_count)), **extra)
    assert_same(load_smpl(path), joint_count)


@pytest.mark.parametrize("matrix", [csc_matrix, csr_matrix])
@pytest.mark.parametrize("protocol", [0, 2, 4])
def test_pickle_with_sparse_regressor_and_chumpy_gives_the_model(tmp_path, monkeypatch, matrix, protocol: int) -> None:
    contents = file_contents(sample_arrays(24))
    chumpy = Chumpy(monkeypatch)
    shapedirs = contents["shapedirs"]
    order = np.random.default_rng(0).permutation(shapedirs.size)
    scattered = np.empty(shapedirs.size)
    scattered[order] = shapedirs.ravel()
    changed = {
        "J_regressor": matrix(contents["J_regressor"]),
        "v_template": chumpy.variable(contents["v_template"]),
        "shapedirs": chumpy.selection(chumpy.variable(scattered.reshape(-1, 2)), order, shapedirs.shape),
        "bs_type": "lrotmin",
    }
    path = write_pickle(tmp_path / "model.pkl", contents | changed, protocol)
    monkeypatch.undo()
    assert "chumpy.ch" not in sys.modules
    assert_same(load_smpl(path), 24)


def test_old_module_names_of_scipy_are_read(tmp_path) -> None:
    """Scipy for Python 2 had its matrices in `scipy.sparse.csc`, now `scipy.sparse._csc`."""
    contents = file_contents(sample_arrays(24))
    path = write_pickle(tmp_path / "model.pkl", contents | {"J_regressor": csc_matrix(contents["J_regressor"])})
    new = path.read_bytes()
    old = new.replace(b"cscipy.sparse._csc\n", b"cscipy.sparse.csc\n")
    assert old != new
    path.write_bytes(old)
    assert_same(load_smpl(path), 24)


def test_only_the_first_ten_shape_directions_are_used(tmp_path) -> None:
    contents = file_contents(sample_arrays(55))
    more = np.concatenate([contents["shapedirs"], np.ones((*contents["shapedirs"].shape[:2], 30))], axis=2)
    np.savez(tmp_path / "model.npz", **(contents | {"shapedirs": more}))
    assert_same(load_smpl(tmp_path / "model.npz"), 55)


@pytest.mark.parametrize(
    ("key", "value", "reason"),
    [
        ("weights", None, "has no `weights`"),
        ("weights", np.ones((3, 24)), r"`weights` has shape \(3, 24\)"),
        ("v_template", np.ones((5, 3)), r"`v_template` has shape \(5, 3\)"),
        ("shapedirs", np.ones((5, 3, 10)), "`shapedirs` has shape"),
        ("f", np.full((4, 3), 10**6, dtype=np.uint32), "does not hold triangles"),
        ("kintree_table", np.zeros((2, 23), dtype=np.uint32), "`kintree_table` has shape"),
        ("kintree_table", np.full((2, 24), 23, dtype=np.uint32), "precedes its parent"),
    ],
)
def test_invalid_arrays_are_refused_by_name(tmp_path, key: str, value, reason: str) -> None:
    contents = file_contents(sample_arrays(24))
    del contents[key]
    path = tmp_path / "model.npz"
    np.savez(path, **contents, **({} if value is None else {key: value}))
    with pytest.raises(UserError, match=rf"model.npz .*{reason}"):
        load_smpl(path)


def test_a_missing_file_a_text_and_a_list_are_refused(tmp_path) -> None:
    for name in ("none.npz", "none.pkl"):
        with pytest.raises(UserError, match=name):
            load_smpl(tmp_path / name)
    (tmp_path / "text.npz").write_text("model")
    with pytest.raises(UserError, match="text.npz cannot be read"):
        load_smpl(tmp_path / "text.npz")
    with pytest.raises(UserError, match="holds a list"):
        load_smpl(write_pickle(tmp_path / "list.pkl", [1, 2]))


def test_damaged_sparse_matrices_and_other_objects_are_refused(tmp_path) -> None:
    contents = file_contents(sample_arrays(24))
    broken = csc_matrix(contents["J_regressor"])
    broken.indices[:] = 10**6  # would write outside of the matrix
    for value in (broken, [1, 2, 3]):
        path = write_pickle(tmp_path / "model.pkl", contents | {"J_regressor": value})
        with pytest.raises(UserError, match=r"model.pkl is not an SMPL"):
            load_smpl(path)
    with pytest.raises(ValueError, match="dict instead of an array"):
        plain_array({})


def test_shapes_agree_with_the_smplx_package(tmp_path) -> None:
    """Compare the T-pose joints for the same betas; only where smplx is installed (non-commercial licence)."""
    smplx = pytest.importorskip("smplx")
    from smplx.utils import Struct

    contents = file_contents(sample_arrays(24))
    data = Struct(**contents, posedirs=np.zeros((*contents["v_template"].shape, 207)))
    few = dict.fromkeys(("nose", "reye", "leye", "rear", "lear"), 0)
    feet = dict.fromkeys(("LBigToe", "LSmallToe", "LHeel", "RBigToe", "RSmallToe", "RHeel"), 0)
    tips = {f"{side}{tip}": 0 for side in "lr" for tip in ("thumb", "index", "middle", "ring", "pinky")}
    reference = smplx.SMPL("", data_struct=data, vertex_ids={**few, **feet, **tips})
    theta = 0.3 * torch.randn(1, 24, 3, generator=torch.Generator().manual_seed(3))
    betas = torch.linspace(-1.0, 1.0, 10)
    with torch.no_grad():
        output = reference(betas=betas[None], body_pose=theta[:, 1:].flatten(1), global_orient=theta[:, 0])
    np.savez(tmp_path / "model.npz", **contents)
    body = load_smpl(tmp_path / "model.npz")

    from pipeline.geometry.rotation import axis_angle_to_matrix
    from pipeline.geometry.skinning import forward_kinematics

    joints = body.rest_pose(betas)[1]
    ours = forward_kinematics(
        body.from_smpl_rotations(axis_angle_to_matrix(theta)), joints[None, 0], joints, body.parents
    )
    found, expected = ours[0, :, :3, 3], output.joints[0, :24]
    assert torch.allclose(found - found[0], expected - expected[0], atol=1e-5)
