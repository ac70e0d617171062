"""SMPL poses on disk: a round trip, and the sentence for each file that does not fit."""

import numpy as np
import pytest

from pipeline.capture.smpl_poses import SmplPoses, load_smpl_poses, save_smpl_poses
from pipeline.core.errors import UserError
from pipeline.io.npz import load_npz, save_npz


def make_poses(n: int = 3) -> SmplPoses:
    rng = np.random.default_rng(0)

    def rows(*shape: int) -> np.ndarray:
        return rng.normal(size=(n, *shape)).astype(np.float32)

    index = np.arange(n, dtype=np.int32) * 4
    turned = rows(4, 4)
    turned[:, :3, :3] = np.linalg.qr(turned[:, :3, :3])[0]
    turned[:, :3, 0] *= np.linalg.det(turned[:, :3, :3])[:, None]
    turned[:, 3] = [0, 0, 0, 1]
    return SmplPoses(index, rows(3), rows(69), rows(3), rows(10), turned, "female")


def test_round_trip(tmp_path):
    poses = make_poses()
    save_smpl_poses(tmp_path / "p.npz", poses)
    read = load_smpl_poses(tmp_path / "p.npz")
    for name, value in vars(poses).items():
        np.testing.assert_array_equal(getattr(read, name), value)


def test_rows_of_some_frames():
    poses = make_poses(5)
    some = poses.for_frames(np.array([2, 4, 7, 16, 400]))
    np.testing.assert_array_equal(some.frame_index, [4, 16])
    np.testing.assert_array_equal(some.transl, poses.transl[[1, 4]])
    assert some.gender == "female"


def test_gender_may_be_left_out(tmp_path):
    save_smpl_poses(tmp_path / "p.npz", make_poses())
    arrays = load_npz(tmp_path / "p.npz")
    del arrays["gender"]
    save_npz(tmp_path / "p.npz", arrays)
    assert load_smpl_poses(tmp_path / "p.npz").gender == "unknown"


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("body_pose", np.zeros((3, 72)), r"`body_pose` must have shape \(3, 69\), found \(3, 72\)"),
        ("betas", np.zeros(10), r"`betas` must have shape \(3, 10\)"),
        ("transl", None, "`transl` must have shape .* found None"),
        ("frame_index", None, "`frame_index` must have shape"),
        ("frame_index", np.array([0, 4, 4]), "does not increase"),
        ("gender", np.array("giant"), "gender is giant"),
        ("transl", np.full((3, 3), np.nan), "`transl` holds a value that is not finite"),
        ("smpl_to_camera", np.tile(2 * np.eye(4), (3, 1, 1)), "must be a rotation with translation"),
        ("smpl_to_camera", np.tile(np.diag([1.0, -1, 1, 1]), (3, 1, 1)), "must be a rotation with translation"),
        ("smpl_to_camera", np.tile(np.diag([1.0, 1, 1, 2]), (3, 1, 1)), "must be a rotation with translation"),
    ],
)
def test_what_does_not_fit_is_named(tmp_path, name, value, message):
    save_smpl_poses(tmp_path / "p.npz", make_poses())
    arrays = load_npz(tmp_path / "p.npz")
    arrays.pop(name)
    if value is not None:
        arrays[name] = value
    save_npz(tmp_path / "p.npz", arrays)
    with pytest.raises(UserError, match=message):
        load_smpl_poses(tmp_path / "p.npz")
