"""Triangles split along borders of regions: the same closed surface, each face in one region."""

import numpy as np
import trimesh

from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface_cut import MIN_FRACTION, UnsplitNormals, cut_at_borders


def sphere() -> Mesh:
    ball = trimesh.creation.icosphere(subdivisions=3)
    return Mesh(np.asarray(ball.vertices), np.asarray(ball.faces))


def sector(points: np.ndarray) -> np.ndarray:
    """Six regions that meet at both poles: thirds of the turn, north and south."""
    turn = np.floor((np.arctan2(points[:, 1], points[:, 0]) + np.pi) / (2 * np.pi / 3)).astype(int) % 3
    return turn + 3 * (points[:, 2] > 0.01)


def test_a_cut_sphere_is_the_same_closed_surface() -> None:
    mesh = sphere()
    cut, region = cut_at_borders(mesh, sector)
    surface = cut.apply(mesh)
    assert len(surface.faces) > len(mesh.faces)
    assert surface.is_watertight()
    np.testing.assert_allclose(surface.face_areas_m2().sum(), mesh.face_areas_m2().sum(), rtol=1e-12)
    assert (np.sum(surface.face_normals() * surface.vertices[surface.faces].mean(axis=1), axis=1) > 0.9).all()
    np.testing.assert_array_equal(surface.vertices[: len(mesh.vertices)], mesh.vertices)


def test_each_face_lies_in_its_region_up_to_the_clipped_ends() -> None:
    mesh = sphere()
    cut, region = cut_at_borders(mesh, sector)
    surface = cut.apply(mesh)
    middle = surface.vertices[surface.faces].mean(axis=1)
    wrong = sector(middle) != region
    areas = surface.face_areas_m2()
    # At the corners where three regions meet, the middle of a face is not the exact meeting point.
    assert areas[wrong].sum() < 0.002 * areas.sum()
    assert set(region) == set(range(6))
    edge = cut.weights[cut.corners[:, 1] == cut.corners[:, 2]]
    assert edge[:, 0].min() >= MIN_FRACTION
    np.testing.assert_allclose(cut.weights.sum(axis=1), 1.0)


def test_a_mesh_of_one_region_stays_as_it_is() -> None:
    mesh = sphere()
    cut, region = cut_at_borders(mesh, lambda points: np.zeros(len(points), dtype=int))
    np.testing.assert_array_equal(cut.faces, mesh.faces)
    assert len(cut.corners) == 0
    assert not region.any()


def bend(points: np.ndarray) -> np.ndarray:
    """A pose: the upper half of the sphere leans over."""
    return points + np.stack([0.4 * points[:, 2] ** 2, 0.0 * points[:, 0], 0.1 * points[:, 0]], axis=1)


def test_normals_are_those_before_the_cut_in_any_pose() -> None:
    mesh = sphere()
    cut, _ = cut_at_borders(mesh, sector)
    count = len(mesh.vertices)
    unsplit = UnsplitNormals(mesh.faces, count + np.arange(len(cut.corners)), cut.corners, cut.weights)
    for posed in (mesh.vertices, bend(mesh.vertices)):
        before = Mesh(posed, mesh.faces).vertex_normals()
        between = np.einsum("nk,nkc->nc", cut.weights, before[cut.corners])
        expected = np.concatenate([before, between / np.linalg.norm(between, axis=1, keepdims=True)])
        found = unsplit.vertex_normals(cut.extend(posed))
        np.testing.assert_allclose(found, expected, atol=1e-12)
        split = Mesh(cut.extend(posed), cut.faces).vertex_normals()
        assert np.degrees(np.arccos(np.clip(np.sum(split * expected, axis=1), -1.0, 1.0))).max() > 1.0
