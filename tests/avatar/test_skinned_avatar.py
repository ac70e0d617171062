"""The mesh of the exported files: normals of the surface before it was split, on both sides of a seam."""

import numpy as np
import trimesh

from pipeline.avatar.skinned_avatar import build_skinned_mesh
from pipeline.geometry.atlas import Atlas
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface_cut import cut_at_borders
from pipeline.mesh.files import MeshArtifact


def test_both_sides_of_a_seam_have_the_normal_of_the_surface_before_the_cut() -> None:
    ball = trimesh.creation.icosphere(subdivisions=2)
    mesh = Mesh(np.asarray(ball.vertices), np.asarray(ball.faces))
    count = len(mesh.vertices)
    joints, weights = np.tile(np.arange(4, dtype=np.int32), (count, 1)), np.full((count, 4), 0.25, np.float32)
    before = MeshArtifact(mesh, joints, weights, np.zeros((count, 3), np.float32))
    cut, side = cut_at_borders(mesh, lambda points: (points[:, 0] > 0.1).astype(int))
    skinned = before.cut(cut)
    corner = cut.faces + len(skinned.mesh.vertices) * side[:, None]
    used, faces_uv = np.unique(corner, return_inverse=True)
    atlas = Atlas(np.zeros((len(used), 2)), faces_uv.reshape(-1, 3), used % len(skinned.mesh.vertices))
    exported = build_skinned_mesh(skinned, atlas)
    assert len(used) > len(skinned.mesh.vertices)  # the seam
    expected = cut.extend(mesh.vertex_normals())[atlas.vertex_of_uv]
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(exported.normals, expected, atol=1e-6)
