"""Fewer faces on a wavy column whose vertices are doubled along a seam."""

import numpy as np
import pytest
import trimesh

from pipeline.geometry.mesh import Mesh
from pipeline.geometry.simplification import ReducedFaces
from pipeline.geometry.simplification import collapse_edges as reduce_faces
from pipeline.geometry.surface import closest_points_on_mesh, collapse_edges
from tests.avatar.formats.column import ALONG, AROUND, column_mesh

FULL = column_mesh()
SEAM = np.isclose(FULL.uv[:, 0] % 1.0, 0.0)


@pytest.fixture(scope="module", params=[0.5, 0.25])
def reduced(request: pytest.FixtureRequest) -> ReducedFaces:
    count = round(request.param * len(FULL.faces))
    made = reduce_faces(FULL.positions_m, FULL.faces, count)
    assert abs(len(made.faces) - count) <= 2
    return made


def test_the_seam_stays_closed(reduced: ReducedFaces) -> None:
    positions = FULL.positions_m[reduced.source_vertex]
    _, welded = np.unique(positions, axis=0, return_inverse=True)
    faces = welded[reduced.faces]
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    ends = positions[reduced.faces].reshape(-1, 3)[:, 1]
    _, count = np.unique(edges, axis=0, return_counts=True)
    assert set(count) == {1, 2}
    assert 4 < (count == 1).sum() < 2 * AROUND + 2  # only the rims at top and bottom are open
    assert ends.min() == 0.0


def test_the_surface_stays(reduced: ReducedFaces) -> None:
    mesh = Mesh(FULL.positions_m[reduced.source_vertex], reduced.faces)
    distance_m, _, _ = closest_points_on_mesh(FULL.positions_m, mesh)
    assert distance_m.max() < 0.004
    facing = np.einsum("fa,fa->f", mesh.face_normals(), FULL.normals[reduced.source_vertex[reduced.faces[:, 0]]])
    area_m2 = mesh.face_areas_m2()
    assert area_m2[facing < 0.5].sum() < 1e-4 * area_m2.sum()


def test_other_reductions_in_the_process_change_nothing() -> None:
    """MeshLab keeps the parameters of its last call as defaults of the next one."""
    count = len(FULL.faces) // 4
    first = reduce_faces(FULL.positions_m, FULL.faces, count)
    ball = trimesh.creation.icosphere(subdivisions=4)
    mesh = Mesh(ball.vertices.astype(np.float32), ball.faces.astype(np.int32))
    collapse_edges(mesh, np.ones(len(mesh.faces), dtype=bool), 500)
    second = reduce_faces(FULL.positions_m, FULL.faces, count)
    np.testing.assert_array_equal(first.source_vertex, second.source_vertex)
    np.testing.assert_array_equal(first.faces, second.faces)


def test_a_turned_face_would_be_noticed() -> None:
    turned = Mesh(FULL.positions_m, FULL.faces[:, ::-1])
    assert np.einsum("fa,fa->f", turned.face_normals(), FULL.normals[FULL.faces[:, 0]]).max() < -0.9


def test_the_column_has_a_seam() -> None:
    assert SEAM.sum() == 2 * ALONG
