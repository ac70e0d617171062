"""Mesh quality metrics of meshes with known defects."""

from itertools import permutations

import numpy as np
import pytest
import trimesh

from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import count_self_intersecting_faces
from pipeline.metrics.health import (
    component_count,
    is_manifold,
    mesh_quality_metrics,
    min_face_angles_deg,
)


def box(centre: tuple[float, float, float] = (0.0, 0.0, 0.0), side_m: float = 1.0) -> Mesh:
    made = trimesh.creation.box(extents=[side_m] * 3)
    return Mesh(np.asarray(made.vertices) + centre, np.asarray(made.faces, dtype=np.int32))


def concatenate_meshes(a: Mesh, b: Mesh) -> Mesh:
    return Mesh(np.concatenate([a.vertices, b.vertices]), np.concatenate([a.faces, b.faces + len(a.vertices)]))


def test_metrics_of_a_box():
    health = mesh_quality_metrics(box())
    assert health == {
        "vertices": 8,
        "faces": 12,
        "watertight": True,
        "manifold": True,
        "components": 1,
        "sliver_fraction": 0.0,
        "min_angle_deg": pytest.approx(45.0),
        "self_intersecting_faces": 0,
    }


def test_a_box_with_a_hole_is_manifold_but_not_watertight():
    open_box = Mesh(box().vertices, box().faces[1:])
    assert not mesh_quality_metrics(open_box)["watertight"]
    assert is_manifold(open_box)


def test_three_faces_on_an_edge_are_not_manifold():
    vertices = np.array([[0, 0, 0], [1.0, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1]])
    assert not is_manifold(Mesh(vertices, np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]], dtype=np.int32)))


def test_two_boxes_that_share_a_vertex_are_not_manifold():
    two = concatenate_meshes(box(), box((1.0, 1.0, 1.0)))
    corner = np.argmax(np.all(two.vertices[:8] == 0.5, axis=1))
    twin = 8 + np.argmax(np.all(two.vertices[8:] == 0.5, axis=1))
    pinched = Mesh(two.vertices, np.where(two.faces == twin, corner, two.faces))
    assert is_manifold(two)
    assert not is_manifold(pinched)
    assert component_count(two) == 2
    assert component_count(pinched) == 1


def test_vertices_without_faces_do_not_count_as_components():
    assert component_count(Mesh(np.zeros((9, 3)), np.array([[1, 3, 5]], dtype=np.int32))) == 1


def test_faces_of_overlapping_boxes_are_counted():
    assert count_self_intersecting_faces(concatenate_meshes(box(), box((3.0, 0.0, 0.0)))) == 0
    assert count_self_intersecting_faces(concatenate_meshes(box(), box((0.4, 0.3, 0.2)))) > 4


def pierces(ends: np.ndarray, corners: np.ndarray) -> bool:
    """Whether the segment between two points intersects a triangle, by a linear solver."""
    sides = corners[1:] - corners[0]
    along, u, v = np.linalg.solve(np.column_stack([ends[0] - ends[1], *sides]), ends[0] - corners[0])
    return bool(0 < along < 1 and u > 0 and v > 0 and u + v < 1)


def reference_self_intersections(mesh: Mesh) -> int:
    """Number of faces in a pair of which an edge of one intersects the other, by testing all pairs."""
    intersecting = set()
    for one, other in permutations(range(len(mesh.faces)), 2):
        for ends in mesh.faces[one][[[0, 1], [1, 2], [2, 0]]]:
            disjoint = not set(ends) & set(mesh.faces[other])
            if disjoint and pierces(mesh.vertices[ends], mesh.vertices[mesh.faces[other]]):
                intersecting |= {one, other}
    return len(intersecting)


def test_count_agrees_with_a_test_of_all_pairs(rng):
    """Random triangles, and others that share one corner with one of them."""
    corners = rng.random((30, 1, 3)) + 0.15 * rng.normal(size=(30, 3, 3))
    attached = corners[:10, :1] + 0.15 * rng.normal(size=(10, 2, 3))
    faces = np.concatenate([np.arange(90).reshape(30, 3), np.stack([3 * np.arange(10), *_rows(90, 10)], axis=1)])
    mesh = Mesh(np.concatenate([corners.reshape(-1, 3), attached.reshape(-1, 3)]), faces.astype(np.int32))
    expected = reference_self_intersections(mesh)
    assert 5 < expected < 35
    assert count_self_intersecting_faces(mesh) == mesh_quality_metrics(mesh)["self_intersecting_faces"] == expected


def _rows(start: int, count: int) -> np.ndarray:
    """Indices of `count` consecutive pairs of vertices, first and second of each pair."""
    return (start + np.arange(2 * count)).reshape(count, 2).T


def test_slivers_are_faces_with_an_angle_below_ten_degrees():
    """Right-angled triangles with a leg of 1 and a known angle at it, one above the other."""
    angles_deg = np.array([2.0, 9.9, 10.1, 40.0, 44.0])
    rise = np.tan(np.radians(angles_deg))
    vertices = np.array([[[0, 0, k], [1, 0, k], [1, rise[k], k]] for k in range(5)]).reshape(-1, 3)
    health = mesh_quality_metrics(Mesh(vertices, np.arange(15, dtype=np.int32).reshape(5, 3)))
    assert health["sliver_fraction"] == pytest.approx(2 / 5)
    assert health["min_angle_deg"] == pytest.approx(2.0)
    assert health["components"] == 5


def test_smallest_angle_agrees_with_the_law_of_cosines(rng):
    mesh = Mesh(rng.normal(size=(3, 3)), np.array([[0, 1, 2]], dtype=np.int32))
    a, b, c = (np.linalg.norm(mesh.vertices[i] - mesh.vertices[(i + 1) % 3]) for i in range(3))
    cosines = [
        (a * a + b * b - c * c) / (2 * a * b),
        (b * b + c * c - a * a) / (2 * b * c),
        (a * a + c * c - b * b) / (2 * a * c),
    ]
    assert min_face_angles_deg(mesh)[0] == pytest.approx(np.degrees(np.arccos(cosines)).min())
    flat = Mesh(np.array([[0, 0, 0], [1.0, 0, 0], [2, 0, 0]]), mesh.faces)
    assert min_face_angles_deg(flat)[0] == pytest.approx(0.0)
