"""Tangent frames: closed forms on a cylinder, mirrored charts, corners without a direction."""

import numpy as np
import pytest

from pipeline.geometry.tangents import tangent_frames, vertex_tangents

COLUMNS, ROWS = 24, 5


def cylinder_sheet() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return positions, outward normals, uv, faces of a sheet (u around, v up), and the true tangents."""
    angle, height = np.meshgrid(np.linspace(-1.0, 1.0, COLUMNS), np.linspace(0.0, 1.0, ROWS))
    angle_rad, y = angle.ravel(), height.ravel()
    positions = np.stack([np.sin(angle_rad), y, np.cos(angle_rad)], axis=1)
    normals = positions * [1.0, 0.0, 1.0]
    tangents = np.stack([np.cos(angle_rad), 0.0 * y, -np.sin(angle_rad)], axis=1)
    first = (np.arange(ROWS - 1)[:, None] * COLUMNS + np.arange(COLUMNS - 1)).ravel()
    right, above = first + 1, first + COLUMNS
    faces = np.concatenate([np.stack([first, right, above + 1], 1), np.stack([first, above + 1, above], 1)])
    return positions, normals, np.stack([0.5 + 0.4 * angle_rad, 0.3 * y], axis=1), faces, tangents


def test_tangents_of_a_cylinder_are_exact() -> None:
    positions, normals, uv, faces, expected = cylinder_sheet()
    tangents = vertex_tangents(positions, normals, uv, faces)
    np.testing.assert_allclose(tangents[:, :3], expected, atol=1e-6)
    np.testing.assert_array_equal(tangents[:, 3], 1.0)
    frames = tangent_frames(normals, tangents)
    np.testing.assert_allclose(frames[:, :, 1], np.tile([0.0, 1.0, 0.0], (len(uv), 1)), atol=1e-6)


def test_a_mirrored_chart_has_the_other_sign() -> None:
    positions, normals, uv, faces, expected = cylinder_sheet()
    tangents = vertex_tangents(positions, normals, uv * [-1.0, 1.0] + [1.0, 0.0], faces)
    np.testing.assert_allclose(tangents[:, :3], -expected, atol=1e-6)
    np.testing.assert_array_equal(tangents[:, 3], -1.0)
    np.testing.assert_allclose(tangent_frames(normals, tangents)[:, 1, 1], 1.0, atol=1e-6)


def test_tangents_do_not_depend_on_the_scale_of_the_chart() -> None:
    positions, normals, uv, faces, _ = cylinder_sheet()
    half_width = vertex_tangents(positions, normals, uv * [0.5, 1.0], faces)
    np.testing.assert_allclose(half_width, vertex_tangents(positions, normals, uv, faces), atol=1e-6)


def test_faces_count_by_their_angle() -> None:
    """Two faces at a vertex, of 90 and 45 degrees, whose u grows along x and along y."""
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [-1, 1, 0]], dtype=float)
    uv = np.array([[0, 0], [1, 0], [0, 1], [0.0, 2.0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    normals = np.tile([0.0, 0.0, 1.0], (4, 1))
    # in the second face v grows 1 along y and 2 along (-1, 1): the direction of constant v is (1, 1) / sqrt(2)
    uv[3] = (-1.0, 2.0)
    gradient_rows = np.linalg.inv(np.array([[0.0, 1.0], [-1.0, 1.0]])) @ np.array([[0.0, 1.0], [-1.0, 2.0]])
    along_u = np.linalg.inv(gradient_rows.T)[:, 0]
    expected = 90.0 * np.array([1.0, 0.0]) + 45.0 * along_u / np.linalg.norm(along_u)
    tangents = vertex_tangents(positions, normals, uv, faces)
    np.testing.assert_allclose(tangents[0, :2], expected / np.linalg.norm(expected), atol=1e-6)


@pytest.mark.parametrize("uv", [np.zeros((3, 2)), np.array([[0, 0], [0, 1], [0, 2.0]])])
def test_a_vertex_without_a_direction_gets_a_unit_tangent_in_its_plane(uv: np.ndarray) -> None:
    positions, normals = np.eye(3), np.full((3, 3), 3.0**-0.5)
    tangents = vertex_tangents(positions, normals, uv, np.array([[0, 1, 2]]))
    np.testing.assert_allclose(np.linalg.norm(tangents[:, :3], axis=1), 1.0, atol=1e-6)
    np.testing.assert_allclose(np.sum(tangents[:, :3] * normals, axis=1), 0.0, atol=1e-6)
