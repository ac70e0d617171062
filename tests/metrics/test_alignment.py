"""Alignment recovers a known similarity transform."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from pipeline.geometry.mesh import Mesh
from pipeline.geometry.similarity import SimilarityTransform
from pipeline.metrics.alignment import align_surfaces_icp
from pipeline.metrics.surfaces import surface_scores

TRUE_TRANSFORM = SimilarityTransform(
    1.07, Rotation.from_rotvec([0.1, -0.2, 0.15]).as_matrix(), np.array([0.3, -0.1, 2.0])
)


def cross(subdivisions: int = 3) -> Mesh:
    """Three boxes of different sizes, without a symmetry that would make the rotation ambiguous."""
    parts = [
        trimesh.creation.box((0.4, 1.8, 0.3)),
        trimesh.creation.box((1.2, 0.2, 0.2)).apply_translation([0.2, 0.5, 0.0]),
        trimesh.creation.box((0.2, 0.3, 0.7)).apply_translation([0.0, 0.7, 0.3]),
    ]
    made = trimesh.util.concatenate(parts)
    for _ in range(subdivisions):
        made = made.subdivide()
    return Mesh(np.asarray(made.vertices), np.asarray(made.faces, dtype=np.int32))


def test_icp_aligns_a_transformed_surface_with_itself():
    mesh = cross()
    found = align_surfaces_icp(mesh, TRUE_TRANSFORM.transform_mesh(cross(2)))  # the same surface with other triangles
    assert found.scale == pytest.approx(TRUE_TRANSFORM.scale, abs=2e-3)
    assert found.rotation == pytest.approx(TRUE_TRANSFORM.rotation, abs=5e-3)
    assert (
        surface_scores(found.transform_mesh(mesh), TRUE_TRANSFORM.transform_mesh(mesh), count=5000)["chamfer_mm"] < 1.0
    )


def test_icp_of_spheres_with_and_without_scale():
    """Two spheres: with scale the distance is zero, without scale it is the difference of the radii."""
    small, large = (trimesh.creation.icosphere(subdivisions=3, radius=radius) for radius in (0.50, 0.52))
    meshes = [Mesh(np.asarray(ball.vertices) + [0, 0, shift], ball.faces) for ball, shift in ((small, 0), (large, 0.1))]
    for with_scale, expected_mm in ((True, 0.0), (False, 20.0)):
        moved = align_surfaces_icp(*meshes, with_scale=with_scale).transform_mesh(meshes[0])
        assert surface_scores(moved, meshes[1], count=3000)["chamfer_mm"] == pytest.approx(expected_mm, abs=0.5)
