"""The files of the mesh stage: what was written is read back, and a wrong file names itself and the next command."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.core.errors import UserError
from pipeline.geometry.creases import Creases
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface_cut import cut_at_borders
from pipeline.io.npz import load_npz, save_npz
from pipeline.mesh.files import (
    DENSE_NPZ,
    MESH_NPZ,
    MeshArtifact,
    load_checkpoint,
    load_dense_mesh,
    load_mesh,
    save_checkpoint,
    save_dense_mesh,
    save_mesh,
)
from pipeline.mesh.pose_alignment import PoseOffsets
from pipeline.mesh.refinement import RefinementState
from pipeline.mesh.skin_transfer import build_skinned_topology

TETRAHEDRON = Mesh(
    np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], dtype=np.float32),
    np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], dtype=np.int32),
)
ARTIFACT = MeshArtifact(
    TETRAHEDRON,
    np.array([[2, 0, 0, 0], [1, 2, 0, 0], [0, 1, 2, 3], [3, 0, 0, 0]], dtype=np.int32),
    np.array([[1, 0, 0, 0], [0.75, 0.25, 0, 0], [0.4, 0.3, 0.2, 0.1], [1, 0, 0, 0]], dtype=np.float32),
    np.linspace(0.0, 1.0, 12, dtype=np.float32).reshape(4, 3),
)
OFFSETS = PoseOffsets(torch.linspace(-0.1, 0.1, 12).view(2, 2, 3), torch.linspace(0.0, 0.01, 6).view(2, 3))


def test_a_mesh_is_read_back(tmp_path: Path) -> None:
    save_mesh(tmp_path, ARTIFACT)
    loaded = load_mesh(tmp_path)
    np.testing.assert_array_equal(loaded.mesh.vertices, TETRAHEDRON.vertices)
    np.testing.assert_array_equal(loaded.mesh.faces, TETRAHEDRON.faces)
    for name in ("joint_indices", "joint_weights", "vertex_colours"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(ARTIFACT, name))


def test_what_is_inside_of_a_skirt_is_read_back_cut_and_split(tmp_path: Path) -> None:
    assert load_mesh_after_saving(tmp_path, ARTIFACT).is_inside is None
    inside = np.array([True, True, False, True])
    loaded = load_mesh_after_saving(tmp_path, replace(ARTIFACT, is_inside=inside))
    np.testing.assert_array_equal(loaded.is_inside, inside)
    cut, _ = cut_at_borders(TETRAHEDRON, lambda points_m: (points_m[:, 0] > 0.3).astype(np.int64))
    of_cut = loaded.cut(cut).is_inside
    np.testing.assert_array_equal(of_cut[:4], inside)
    np.testing.assert_array_equal(of_cut[4:], inside[cut.corners].all(axis=1))
    assert of_cut[4:].any()
    assert not of_cut[4:].all()
    creases = Creases(np.array([0, 1, 2, 3, 2]), TETRAHEDRON.faces)
    np.testing.assert_array_equal(loaded.split(creases).is_inside, [True, True, False, True, False])


def load_mesh_after_saving(folder: Path, artifact: MeshArtifact) -> MeshArtifact:
    save_mesh(folder, artifact)
    return load_mesh(folder)


def test_the_dense_mesh_is_read_back(tmp_path: Path) -> None:
    save_dense_mesh(tmp_path, TETRAHEDRON)
    loaded = load_dense_mesh(tmp_path)
    np.testing.assert_array_equal(loaded.vertices, TETRAHEDRON.vertices)
    np.testing.assert_array_equal(loaded.faces, TETRAHEDRON.faces)
    save_npz(tmp_path / DENSE_NPZ, {"vertices": TETRAHEDRON.vertices})
    with pytest.raises(UserError, match=r"dense\.npz has no array 'faces'; run .*python -m stages mesh"):
        load_dense_mesh(tmp_path)


def test_dense_weights_have_one_row_per_vertex() -> None:
    expected = [[0, 0, 1, 0], [0, 0.75, 0.25, 0], [0.4, 0.3, 0.2, 0.1], [0, 0, 0, 1]]
    torch.testing.assert_close(ARTIFACT.dense_skin_weights(4), torch.tensor(expected))


def test_a_file_without_an_array_names_it_and_the_command(tmp_path: Path) -> None:
    save_mesh(tmp_path, ARTIFACT)
    arrays = load_npz(tmp_path / MESH_NPZ)
    save_npz(tmp_path / MESH_NPZ, {name: array for name, array in arrays.items() if name != "joint_weights"})
    with pytest.raises(UserError, match=r"mesh\.npz has no array 'joint_weights'; run .*python -m stages mesh"):
        load_mesh(tmp_path)


def test_a_checkpoint_is_read_back(tmp_path: Path) -> None:
    weights = torch.tensor([[1.0, 0.0], [0.5, 0.5], [0.25, 0.75], [0.0, 1.0]])
    shader_state = {"mean": torch.tensor(0.25)}
    state = RefinementState(
        TETRAHEDRON, build_skinned_topology(TETRAHEDRON, weights), shader_state, 2, (20.0, 25.5), True, OFFSETS
    )
    assert load_checkpoint(tmp_path / "checkpoint.safetensors") is None
    save_checkpoint(tmp_path / "checkpoint.safetensors", state)
    loaded = load_checkpoint(tmp_path / "checkpoint.safetensors")
    assert loaded is not None
    np.testing.assert_array_equal(loaded.mesh.vertices, TETRAHEDRON.vertices)
    assert torch.equal(loaded.skin.weights, weights)
    assert torch.equal(loaded.skin.adjacency, state.skin.adjacency)
    assert loaded.shader_state == shader_state
    assert (loaded.rounds_done, loaded.validation_psnr_db, loaded.finished) == (2, (20.0, 25.5), True)
    assert loaded.pose_offsets is not None
    assert torch.equal(loaded.pose_offsets.rotation_rad, OFFSETS.rotation_rad)
    assert torch.equal(loaded.pose_offsets.shift_m, OFFSETS.shift_m)
    save_checkpoint(tmp_path / "unaligned.safetensors", replace(state, pose_offsets=None))
    unaligned = load_checkpoint(tmp_path / "unaligned.safetensors")
    assert unaligned is not None
    assert unaligned.pose_offsets is None


def test_a_cut_mesh_keeps_the_normals_of_the_surface_before_the_cut() -> None:
    cut, _ = cut_at_borders(TETRAHEDRON, lambda points: (points[:, 0] > 0.3).astype(int))
    before = TETRAHEDRON.vertex_normals()
    found = ARTIFACT.cut(cut)
    assert np.abs(found.mesh.vertex_normals()[:4] - before).max() > 0.05
    np.testing.assert_allclose(found.vertex_normals()[:4], before, atol=1e-6)
    between = cut.extend(before)[4:]
    between /= np.linalg.norm(between, axis=1, keepdims=True)
    np.testing.assert_allclose(found.vertex_normals()[4:], between, atol=1e-6)
    turned = found.mesh.vertices[:, [1, 2, 0]]  # a rotation: the axes are exchanged cyclically
    np.testing.assert_allclose(found.vertex_normals(turned), found.vertex_normals()[:, [1, 2, 0]], atol=1e-6)
