"""Closed surfaces: spheres and boxes with known distance, area and topology, and meshes with known defects."""

import numpy as np
import pytest

from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import (
    MeshAABBTree,
    OpenSurfaceError,
    closest_points_on_mesh,
    count_self_intersecting_faces,
    is_closed_manifold,
    is_inside,
    isosurface,
    laplacian,
    largest_component,
    largest_solid,
    remesh_isotropic,
    remove_unreferenced_vertices,
    repair,
    resolve_self_intersections,
    signed_distance_m,
    smooth_taubin,
    split_nonmanifold_vertices,
    subdivide,
    subtract,
    weld_vertices,
)

TETRAHEDRON = Mesh(
    np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], dtype=np.float32),
    np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], dtype=np.int32),
)


def ball_grid(radius: float = 0.5, spacing: float = 0.05) -> tuple[np.ndarray, np.ndarray]:
    """Radius minus distance to the origin, on a grid, and the grid's origin."""
    axis = np.arange(-0.7, 0.7001, spacing)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    return radius - np.linalg.norm(points, axis=-1), np.full(3, axis[0])


@pytest.fixture(scope="module")
def sphere() -> Mesh:
    values, origin = ball_grid()
    return isosurface(values, 0.0, origin, 0.05)


def volume(mesh: Mesh) -> float:
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    return float(np.einsum("ij,ij", a, np.cross(b, c)) / 6.0)


def euler_characteristic(mesh: Mesh) -> int:
    return len(remove_unreferenced_vertices(mesh).vertices) - len(mesh.edges()) + len(mesh.faces)


def moved(mesh: Mesh, shift: tuple[float, float, float]) -> Mesh:
    return Mesh(mesh.vertices + np.array(shift, dtype=np.float32), mesh.faces)


def concatenate_meshes(*meshes: Mesh) -> Mesh:
    offsets = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])[:-1]
    faces = [mesh.faces + np.int32(offset) for mesh, offset in zip(meshes, offsets, strict=True)]
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces))


def test_isosurface_of_a_ball(sphere: Mesh) -> None:
    np.testing.assert_allclose(np.linalg.norm(sphere.vertices, axis=1), 0.5, atol=0.004)
    assert volume(sphere) == pytest.approx(4 / 3 * np.pi * 0.125, rel=0.01)  # positive volume: the faces point outward
    assert is_closed_manifold(sphere)
    assert euler_characteristic(sphere) == 2


def test_isosurface_is_closed_where_the_solid_leaves_the_grid() -> None:
    values, origin = ball_grid(radius=0.8)
    assert is_closed_manifold(isosurface(values, 0.0, origin, 0.05))


def test_samples_equal_to_the_isovalue_give_no_degenerate_faces() -> None:
    values = np.zeros((6, 6, 6))
    values[2:4, 2:4, 2:4] = 1.0
    mesh = isosurface(values, 1.0, np.zeros(3), 1.0)
    assert is_closed_manifold(mesh)
    assert (mesh.face_areas_m2() > 0).all()


def test_isosurface_without_inside_names_the_isovalue() -> None:
    with pytest.raises(ValueError, match=r"reaches the isovalue 2; the largest is 1"):
        isosurface(np.ones((3, 3, 3)), 2.0, np.zeros(3), 1.0)


def test_largest_solid_keeps_the_largest_part_and_fills_its_cavity() -> None:
    inside = np.zeros((12, 12, 12), dtype=bool)
    inside[1:8, 1:8, 1:8] = True
    inside[4, 4, 4] = False
    inside[10, 10, 10] = True
    expected = np.zeros_like(inside)
    expected[1:8, 1:8, 1:8] = True
    np.testing.assert_array_equal(largest_solid(inside), expected)
    assert not largest_solid(np.zeros((2, 2, 2), dtype=bool)).any()


def test_largest_component_is_by_area_and_drops_unused_vertices(sphere: Mesh) -> None:
    both = concatenate_meshes(TETRAHEDRON, moved(sphere, (5.0, 0.0, 0.0)))
    kept = largest_component(both)
    np.testing.assert_allclose(kept.vertices, sphere.vertices + np.array([5.0, 0.0, 0.0]), atol=1e-6)
    assert len(kept.faces) == len(sphere.faces)


def test_solids_that_share_one_vertex_are_separated() -> None:
    touching = concatenate_meshes(TETRAHEDRON, moved(TETRAHEDRON, (1.0, 0.0, 0.0)))
    faces = np.where(touching.faces == 4, 1, touching.faces)  # the second's corner 0 is the first's corner 1
    pinched = remove_unreferenced_vertices(Mesh(touching.vertices, faces))
    assert len(pinched.vertices) == 7
    assert pinched.is_watertight()
    assert not is_closed_manifold(pinched)
    split = split_nonmanifold_vertices(pinched)
    assert len(split.vertices) == 8
    assert is_closed_manifold(split)
    assert split_nonmanifold_vertices(split) is split


@pytest.mark.parametrize("seed", range(3))
def test_repair_closes_holes_and_removes_fins(sphere: Mesh, seed: int) -> None:
    generator = np.random.default_rng(seed)
    kept = sphere.faces[generator.random(len(sphere.faces)) > 0.03]
    fins = np.concatenate([sphere.faces[:5, [0, 1]], np.full((5, 1), len(sphere.vertices), dtype=np.int32)], axis=1)
    broken = Mesh(
        np.concatenate([sphere.vertices, [[9.0, 9.0, 9.0]]]).astype(np.float32),
        np.concatenate([kept, kept[:3], fins.astype(np.int32), [[0, 0, 1]]]).astype(np.int32),
    )
    assert not is_closed_manifold(broken)
    repaired = repair(broken)
    assert is_closed_manifold(repaired)
    assert volume(repaired) == pytest.approx(volume(sphere), rel=0.02)


def test_self_intersections_are_resolved_and_the_other_vertices_stay(sphere: Mesh) -> None:
    assert count_self_intersecting_faces(sphere) == 0
    assert resolve_self_intersections(sphere) is sphere
    pushed = sphere.vertices.copy()
    lowest = pushed[:, 1].argmin()
    pushed[lowest] += [0.0, 1.1, 0.0]  # out through the top
    intersecting = Mesh(pushed, sphere.faces)
    assert count_self_intersecting_faces(intersecting) > 5
    repaired = resolve_self_intersections(intersecting)
    assert count_self_intersecting_faces(repaired) == 0
    assert (repaired.faces == sphere.faces).all()
    stayed = (repaired.vertices == sphere.vertices).all(axis=1)
    assert stayed.mean() > 0.9
    # The neighbours of the displaced vertex move by about a sixth of its displacement of 1.1 m.
    assert np.linalg.norm(repaired.vertices - sphere.vertices, axis=1).max() < 0.25


def test_a_surface_that_cannot_be_closed_raises_open_surface_error() -> None:
    with pytest.raises(OpenSurfaceError, match="still has holes after 4 repair iterations"):
        repair(Mesh(TETRAHEDRON.vertices, TETRAHEDRON.faces[:1]))


def test_repair_does_not_change_a_closed_manifold(sphere: Mesh) -> None:
    np.testing.assert_array_equal(repair(sphere).faces, sphere.faces)


def test_remesh_reaches_the_edge_length_and_keeps_the_shape(sphere: Mesh) -> None:
    coarse = remesh_isotropic(sphere, 0.09)
    ends = coarse.vertices[coarse.edges()]
    lengths = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)
    assert np.median(lengths) == pytest.approx(0.09, rel=0.2)
    assert is_closed_manifold(coarse)
    assert np.abs(np.linalg.norm(coarse.vertices, axis=1) - 0.5).max() < 0.01
    assert len(coarse.faces) < 0.5 * len(sphere.faces)


def test_remeshing_a_selection_does_not_change_the_other_faces(sphere: Mesh) -> None:
    upper = sphere.vertices[sphere.faces][:, :, 1].mean(axis=1) > 0.05
    result = remesh_isotropic(sphere, 0.12, selected=upper)
    assert is_closed_manifold(result)
    old = {tuple(np.round(v, 5)) for v in sphere.vertices[np.unique(sphere.faces[~upper])]}
    new = {tuple(np.round(v, 5)) for v in result.vertices}
    assert old <= new
    assert len(result.faces) < len(sphere.faces)


@pytest.mark.parametrize("share", [0.0, 0.05, 0.3, 0.7, 1.0])
def test_subdivision_is_conforming(sphere: Mesh, share: float) -> None:
    marked = np.random.default_rng(1).random(len(sphere.faces)) < share
    fine, ends = subdivide(sphere, marked)
    assert is_closed_manifold(fine)
    assert euler_characteristic(fine) == euler_characteristic(sphere)
    assert volume(fine) == pytest.approx(volume(sphere), rel=1e-6)
    assert fine.face_areas_m2().sum() == pytest.approx(sphere.face_areas_m2().sum(), rel=1e-6)
    np.testing.assert_array_equal(fine.vertices[: len(sphere.vertices)], sphere.vertices)
    np.testing.assert_allclose(fine.vertices[len(sphere.vertices) :], sphere.vertices[ends].mean(axis=1), atol=1e-7)


def test_subdivision_counts_of_one_face() -> None:
    marked = np.array([True, False, False, False])
    fine, ends = subdivide(TETRAHEDRON, marked)
    assert len(fine.faces) == 4 + 3 * 2  # the marked face becomes four faces, each neighbour two
    assert {tuple(e) for e in ends.tolist()} == {(0, 1), (0, 2), (1, 2)}


def test_subdivided_faces_keep_their_orientation(sphere: Mesh) -> None:
    marked = np.random.default_rng(2).random(len(sphere.faces)) < 0.4
    fine, _ = subdivide(sphere, marked)
    centres = fine.vertices[fine.faces].mean(axis=1)
    assert (np.sum(fine.face_normals() * centres, axis=1) > 0).all()


def test_laplacian_of_a_constant_is_zero_and_a_step_shrinks_the_sphere(sphere: Mesh) -> None:
    operator = laplacian(sphere)
    np.testing.assert_allclose(operator @ np.ones(len(sphere.vertices)), 0.0, atol=1e-12)
    dense = np.zeros(len(sphere.vertices))
    neighbours = np.unique(sphere.faces[(sphere.faces == 7).any(axis=1)])
    dense[neighbours] = 1.0
    assert (operator @ dense)[7] == pytest.approx(0.0)  # the vertex and all its neighbours have the value 1
    smoothed = sphere.vertices - 0.5 * (operator @ sphere.vertices)
    assert np.linalg.norm(smoothed, axis=1).mean() < np.linalg.norm(sphere.vertices, axis=1).mean()


def test_smoothing_removes_noise_and_preserves_volume(sphere: Mesh) -> None:
    noise = np.random.default_rng(8).normal(scale=0.01, size=sphere.vertices.shape)
    noisy = Mesh((sphere.vertices + noise).astype(np.float32), sphere.faces)
    result = smooth_taubin(noisy, 10)
    assert np.std(np.linalg.norm(result.vertices, axis=1)) < 0.5 * np.std(np.linalg.norm(noisy.vertices, axis=1))
    assert volume(result) == pytest.approx(volume(sphere), rel=0.02)
    np.testing.assert_array_equal(smooth_taubin(noisy, 0).vertices, noisy.vertices)


def test_closest_point_against_brute_force(sphere: Mesh) -> None:
    points = np.random.default_rng(3).normal(size=(50, 3)) * 0.5
    distance, face, barycentric = closest_points_on_mesh(points, sphere)
    np.testing.assert_allclose(barycentric.sum(axis=1), 1.0)
    assert barycentric.min() >= 0.0
    nearest = np.einsum("nk,nkc->nc", barycentric, sphere.vertices[sphere.faces[face]])
    np.testing.assert_allclose(np.linalg.norm(nearest - points, axis=1), distance, atol=1e-6)
    np.testing.assert_allclose(MeshAABBTree(sphere).closest_points(points), nearest, atol=1e-6)
    weights = np.random.default_rng(4).dirichlet(np.ones(3), size=200)
    samples = np.einsum("sk,fkc->fsc", weights, sphere.vertices[sphere.faces]).reshape(-1, 3)
    brute = np.sqrt(((points[:, None] - samples[None, ::7]) ** 2).sum(axis=2)).min(axis=1)
    assert (distance <= brute + 1e-6).all()
    assert (brute - distance).max() < 0.02


def test_signed_distance_of_a_sphere(sphere: Mesh) -> None:
    points = np.random.default_rng(6).uniform(-0.7, 0.7, size=(300, 3))
    np.testing.assert_allclose(signed_distance_m(points, sphere), np.linalg.norm(points, axis=1) - 0.5, atol=0.005)


def test_the_difference_of_two_balls_is_a_shell_with_an_opening(sphere: Mesh) -> None:
    """A ball of half the radius that reaches through the surface: what is left has the volume of the rest."""
    radius_m = float(np.linalg.norm(sphere.vertices, axis=1).mean())
    centre = np.array([0.0, 0.0, 0.6 * radius_m], np.float32)
    ball = Mesh((0.5 * sphere.vertices + centre).astype(np.float32), sphere.faces)
    rest = subtract(sphere, ball)
    assert is_closed_manifold(rest)
    points = np.random.default_rng(0).uniform(-radius_m, radius_m, (4000, 3))
    expected = is_inside(points, sphere) & ~is_inside(points, ball)
    assert (is_inside(points, rest) == expected).mean() > 0.999
    assert expected.mean() < is_inside(points, sphere).mean() - 0.03


def test_welding_closes_a_surface_whose_faces_have_their_own_vertices(sphere: Mesh) -> None:
    soup = Mesh(
        sphere.vertices[sphere.faces].reshape(-1, 3), np.arange(sphere.faces.size, dtype=np.int32).reshape(-1, 3)
    )
    assert not soup.is_watertight()
    welded = weld_vertices(soup)
    assert welded.is_watertight()
    assert len(welded.vertices) == len(sphere.vertices)
    np.testing.assert_array_equal(welded.vertices[welded.faces], sphere.vertices[sphere.faces])


def test_a_face_that_is_a_line_after_welding_is_removed() -> None:
    """Corners 1 and 4 of the second face are the same point."""
    vertices = np.concatenate([TETRAHEDRON.vertices, TETRAHEDRON.vertices[1:2]])
    welded = weld_vertices(Mesh(vertices, np.array([[0, 1, 2], [1, 4, 3]], dtype=np.int32)))
    assert welded.faces.shape == (1, 3)
    assert len(welded.vertices) == 3
