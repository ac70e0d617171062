"""Cutting of meshes: areas of a disc and its complement in closed form, and surfaces without gaps after joining."""

import igl
import numpy as np
import pytest
import trimesh

from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface_cut import UnsplitNormals, cut_at_borders
from pipeline.template.level_set_cut import boundary_loops, cut_mesh, points_on_edges, split_boundary_faces


def grid(count: int) -> tuple[np.ndarray, np.ndarray]:
    x, y = np.meshgrid(np.linspace(-1, 1, count), np.linspace(-1, 1, count))
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(count * count)], axis=1)
    corner = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).ravel()
    lower = np.stack([corner, corner + 1, corner + count + 1], axis=1)
    upper = np.stack([corner, corner + count + 1, corner + count], axis=1)
    return vertices, np.concatenate([lower, upper])


def angle(points: np.ndarray) -> np.ndarray:
    return np.arctan2(points[:, 1], points[:, 0])


def test_the_parts_have_the_area_of_a_disc_and_its_complement() -> None:
    vertices, faces = grid(41)
    level = np.hypot(*vertices[:, :2].T) - 0.71
    for side, expected in ((level, np.pi * 0.71**2), (-level, 4.0 - np.pi * 0.71**2)):
        part = cut_mesh(faces, side)
        mesh = Mesh(part.interpolate(vertices), part.faces)
        assert mesh.face_areas_m2().sum() == pytest.approx(expected, rel=0.002)
        assert (mesh.face_normals()[:, 2] > 0.9).all()  # the orientation stays


def test_joined_parts_have_the_area_of_the_whole_and_no_gap() -> None:
    coarse, coarse_faces = grid(11)
    fine, fine_faces = grid(53)
    hole = cut_mesh(coarse_faces, 0.6 - np.hypot(*coarse[:, :2].T))
    disc = cut_mesh(fine_faces, np.hypot(*fine[:, :2].T) - 0.6)
    vertices = np.concatenate([hole.interpolate(coarse), disc.interpolate(fine)])
    count, uv = len(hole.edge), np.zeros((len(vertices), 2))
    outer, inner = boundary_loops(hole.boundary[:, ::-1])[0], boundary_loops(disc.boundary)[0] + count
    on_outer = points_on_edges(outer, angle(vertices[outer]), inner, angle(vertices[inner]), True)
    on_inner = points_on_edges(inner, angle(vertices[inner]), outer, angle(vertices[outer]), False)
    backwards = {(v, u): row[::-1] for (u, v), row in on_outer.items()}
    around = split_boundary_faces(hole.faces, hole.faces, uv, backwards)[0]
    within = split_boundary_faces(disc.faces + count, disc.faces, uv, on_inner)[0]
    whole = Mesh(vertices, np.concatenate([around, within]))
    assert sum(len(row) for row in on_outer.values()) == len(inner)
    assert whole.face_areas_m2().sum() == pytest.approx(4.0, rel=0.01)
    assert len(igl.boundary_loop(whole.faces.astype(np.int64))) == 40  # only the outer border of the coarse grid
    edges = np.sort(whole.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 1).sum() == 40


def test_split_faces_interpolate_texture_coordinates() -> None:
    faces, uv = np.array([[0, 1, 2]]), np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    split, split_uv, more = split_boundary_faces(faces, faces, uv, {(1, 2): [(7, 0.25), (8, 0.5)]})
    assert split.tolist() == [[1, 7, 0], [7, 8, 0], [8, 2, 0]]
    np.testing.assert_allclose(more[split_uv[1]], [[0.75, 0.25], [0.5, 0.5], [0.0, 0.0]])


def test_open_boundaries_are_refused() -> None:
    with pytest.raises(ValueError, match="simple loops"):
        boundary_loops(np.array([[0, 1], [1, 2]]))


def test_normals_of_split_triangles_outlast_a_second_cut() -> None:
    """A sphere is split at meridians, then a cap is taken away: normals away from the cap are those of the sphere."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    mesh = Mesh(np.asarray(ball.vertices), np.asarray(ball.faces))
    split, _ = cut_at_borders(mesh, lambda points: (np.arctan2(points[:, 1], points[:, 0]) // 1.1).astype(int))
    count = len(mesh.vertices)
    before = UnsplitNormals(mesh.faces, count + np.arange(len(split.corners)), split.corners, split.weights)
    vertices = split.extend(mesh.vertices)
    part = cut_mesh(split.faces, vertices[:, 2] - 0.52)
    rest = part.interpolate(vertices)
    found = part.keep_unsplit(before, part.faces).vertex_normals(rest)
    expected = part.interpolate(before.vertex_normals(vertices))
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    degrees = np.degrees(np.arccos(np.clip(np.sum(found * expected, axis=1), -1.0, 1.0)))
    near = rest[:, 2] > 0.52 - 2.0 * np.linalg.norm(np.diff(vertices[part.edge], axis=1), axis=2).max() - 0.16
    assert degrees[~near].max() < 1e-3
    assert degrees.max() < 12.0  # on the rim the mean is over the faces that are left
    as_it_is = np.sum(Mesh(rest, part.faces).vertex_normals() * expected, axis=1)[~near]
    assert np.degrees(np.arccos(as_it_is.clip(-1.0, 1.0))).max() > 0.5
