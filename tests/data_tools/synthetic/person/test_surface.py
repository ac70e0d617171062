"""Subdivision and smoothing against counts, areas and closed forms."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from data_tools.synthetic.person.surface import (
    append_midpoint_values,
    face_components,
    hull_exit_distance_m,
    neighbour_averaging_matrix,
    smooth_laplacian,
    subdivide_at_midpoints,
)
from pipeline.geometry.mesh import Mesh
from tests.data_tools.synthetic.shapes import TETRAHEDRON, octahedron, sphere


def test_midpoint_subdivision_preserves_area_and_closed_edges() -> None:
    vertices, faces = octahedron()
    pairs, finer = subdivide_at_midpoints(faces, len(vertices))
    mesh = Mesh(append_midpoint_values(vertices, pairs), finer)
    assert len(pairs) == 12  # one for each edge
    assert len(finer) == 4 * len(faces)
    assert mesh.is_watertight()
    assert mesh.face_areas_m2().sum() == pytest.approx(Mesh(vertices, faces).face_areas_m2().sum(), rel=1e-6)
    assert np.allclose(mesh.face_normals(), np.repeat(Mesh(vertices, faces).face_normals(), 4, axis=0), atol=1e-6)


def test_subdivided_positions_and_uvs_stay_aligned() -> None:
    """UVs that are a linear map of the positions remain so after subdivision, also along a seam."""
    vertices, faces = TETRAHEDRON
    to_uv = np.array([[0.3, 0.1], [-0.2, 0.5], [0.4, 0.2]], dtype=np.float32)
    uv = (vertices @ to_uv)[faces].reshape(-1, 2)
    faces_uv = np.arange(12, dtype=np.int32).reshape(4, 3)
    pairs, finer = subdivide_at_midpoints(faces, len(vertices))
    uv_pairs, finer_uv = subdivide_at_midpoints(faces_uv, len(uv))
    corners = append_midpoint_values(vertices, pairs)[finer]
    assert np.allclose(append_midpoint_values(uv, uv_pairs)[finer_uv], corners @ to_uv, atol=1e-6)


def test_neighbour_mean_against_a_loop() -> None:
    vertices, faces = sphere(1.0, (0.0, 0.0, 0.0), subdivisions=1)
    neighbours: dict[int, set[int]] = {vertex: set() for vertex in range(len(vertices))}
    for a, b, c in faces.tolist():
        neighbours[a] |= {b, c}
        neighbours[b] |= {a, c}
        neighbours[c] |= {a, b}
    slow = np.stack([vertices[sorted(neighbours[v])].mean(axis=0) for v in range(len(vertices))])
    assert np.allclose(neighbour_averaging_matrix(faces, len(vertices)) @ vertices, slow, atol=1e-6)


def test_isolated_vertices_are_not_moved() -> None:
    vertices, faces = TETRAHEDRON
    lonely = np.concatenate([vertices, [[5.0, 6.0, 7.0]]]).astype(np.float32)
    assert np.allclose(smooth_laplacian(lonely, neighbour_averaging_matrix(faces, 5), 3)[4], [5.0, 6.0, 7.0])


def test_smoothing_reduces_a_spike_and_keeps_a_plane() -> None:
    side = np.arange(7, dtype=np.float32)
    grid = np.stack(np.meshgrid(side, side, [0.0], indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float32)
    cell = (np.arange(6)[:, None] * 7 + np.arange(6)).ravel()
    faces = np.concatenate([np.stack([cell, cell + 7, cell + 8], 1), np.stack([cell, cell + 8, cell + 1], 1)])
    mean = neighbour_averaging_matrix(faces.astype(np.int32), len(grid))
    assert np.allclose(smooth_laplacian(grid, mean, 5)[:, 2], 0.0)
    spiked = grid.copy()
    spiked[24, 2] = 1.0
    calmed = smooth_laplacian(spiked, mean, 5)[:, 2]
    assert calmed.max() < 0.3
    assert calmed.min() >= 0.0


def test_components_are_numbered_by_size() -> None:
    vertices, faces = TETRAHEDRON
    both = np.concatenate([faces, octahedron()[1] + len(vertices)])
    parts = face_components(both, 10)
    assert parts.tolist() == [1] * 4 + [0] * 8


@pytest.mark.parametrize("size", [2, 3])
def test_exit_distance_from_a_box(size: int) -> None:
    """A ray leaves the box [-1, 1] where its first coordinate reaches a side, offset by the margin."""
    random = np.random.default_rng(0)
    box = np.stack(np.meshgrid(*[[-1.0, 1.0]] * size), axis=-1).reshape(-1, size)
    starts, directions = random.uniform(-0.9, 0.9, (50, size)), random.normal(size=(50, size))
    directions[0] = np.eye(size)[0]  # along four sides of a cube
    for margin in (0.0, 0.25):
        ahead = ((1.0 + margin) * np.sign(directions) - starts) / np.where(directions == 0.0, np.nan, directions)
        found = hull_exit_distance_m(starts, directions, ConvexHull(box).equations, margin)
        np.testing.assert_allclose(found, np.nanmin(ahead, axis=1), rtol=1e-9)
    middle = hull_exit_distance_m(np.zeros((1, size)), directions, ConvexHull(box).equations)
    np.testing.assert_allclose(middle, 1.0 / np.abs(directions).max(axis=1), rtol=1e-9)
