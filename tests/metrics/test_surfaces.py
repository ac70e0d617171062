"""Surface distances against closed forms and against a brute-force search."""

import numpy as np
import pytest
import trimesh

from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import closest_points_on_mesh
from pipeline.metrics.agreeing_faces import nearest_agreeing_faces
from pipeline.metrics.surfaces import (
    NORMAL_REACH_M,
    chamfer_distance_mm,
    mpjpe_m,
    sample_surface,
    surface_correspondence,
    surface_scores,
)


def sphere(radius_m: float) -> Mesh:
    made = trimesh.creation.icosphere(subdivisions=4, radius=radius_m)
    return Mesh(np.asarray(made.vertices), np.asarray(made.faces, dtype=np.int32))


def square(height_m: float, tilt_deg: float = 0.0) -> Mesh:
    slope = np.tan(np.radians(tilt_deg))
    corners = np.array([[x, height_m + slope * x, z] for x in (-0.5, 0.5) for z in (-0.5, 0.5)])
    return Mesh(corners, np.array([[0, 1, 2], [2, 1, 3]], dtype=np.int32))


def test_distance_of_concentric_spheres_is_the_difference_of_their_radii():
    scores = surface_scores(sphere(0.503), sphere(0.5), count=20_000)
    for name in ("result_to_truth_mm", "truth_to_result_mm", "chamfer_mm", "hausdorff95_mm"):
        assert scores[name] == pytest.approx(
            3.0, abs=0.1
        )  # the faces of the icosphere are at most 0.2 mm inside the sphere
    assert scores["f_score"] == 1.0
    assert scores["normal_angle_deg"] < 2.0
    assert surface_scores(sphere(0.51), sphere(0.5), count=2_000)["f_score"] == 0.0


def test_tilted_square_has_the_tilt_as_normal_angle():
    tilted, level = (Mesh(0.2 * made.vertices, made.faces) for made in (square(0.0, tilt_deg=10.0), square(0.0)))
    scores = surface_scores(tilted, level, count=5_000)  # at most 18 mm apart
    assert scores["normal_angle_deg"] == pytest.approx(10.0, abs=1e-6)


def test_normal_angle_is_the_mean_of_both_directions():
    """The truth has an additional square at 60 degrees to the first, which is half of its area."""
    floor, slope = square(0.0), np.radians(60.0)
    across = floor.vertices[:, :1] + 0.5
    wall = np.concatenate([0.5 + across * np.cos(slope), across * np.sin(slope), floor.vertices[:, 2:]], axis=1)
    both = Mesh(np.concatenate([floor.vertices, wall]), np.concatenate([floor.faces, floor.faces + 4]))
    near = NORMAL_REACH_M / np.sin(slope)  # share of the wall within reach of the floor; the rest counts as 90 degrees
    expected_deg = (0 + (near * 60 + (1 - near) * 90) / 2) / 2
    assert surface_scores(floor, both, count=20_000)["normal_angle_deg"] == pytest.approx(expected_deg, abs=0.3)


@pytest.mark.parametrize(("lining_m", "outer_m"), [(0.001, 0.004), (-0.001, -0.004)])
def test_a_lining_that_faces_inwards_has_no_normal_angle(lining_m, outer_m):
    """The nearest surface is the lining of a thin shell, whose normal points the other way; the shell itself agrees."""
    lining, outer = square(lining_m), square(outer_m, tilt_deg=5.0)
    shell = Mesh(
        np.concatenate([lining.vertices, outer.vertices]), np.concatenate([lining.faces[:, ::-1], outer.faces + 4])
    )
    points, _ = sample_surface(square(0.0), 2000)
    normals = np.tile([0.0, 1.0, 0.0], (len(points), 1)) * np.sign(square(0.0).face_normals()[0, 1])
    distances_m, faces = nearest_agreeing_faces(points, normals, shell, NORMAL_REACH_M)
    heights_m = np.abs(outer_m + np.tan(np.radians(5.0)) * points[:, 0]) * np.cos(np.radians(5.0))
    reached = heights_m < NORMAL_REACH_M - 1e-6
    assert set(faces[reached].tolist()) == {2, 3}
    assert set(faces[heights_m > NORMAL_REACH_M + 1e-6].tolist()) == {-1}
    inner = reached & (np.abs(points[:, 0]) < 0.45)
    assert np.allclose(distances_m[inner], heights_m[inner], atol=1e-9)


def test_without_an_agreeing_face_the_angle_is_a_right_angle():
    flipped = Mesh(square(0.001).vertices, square(0.001).faces[:, ::-1])
    assert surface_scores(square(0.0), flipped, count=500)["normal_angle_deg"] == 90.0
    assert surface_scores(square(0.0), square(0.031), count=500)["normal_angle_deg"] == 90.0
    assert surface_scores(square(0.0), square(0.029), count=500)["normal_angle_deg"] == pytest.approx(0.0, abs=1e-6)


def test_agreeing_faces_equal_a_brute_force_search(rng):
    """Random triangles of sizes from 1 mm to 0.3 m; each pair of point and triangle by trimesh."""
    count = 300
    size_m = 10.0 ** rng.uniform(-3, -0.5, (count, 1, 1))
    corners = rng.uniform(-0.1, 0.1, (count, 1, 3)) + size_m * rng.normal(size=(count, 3, 3))
    mesh = Mesh(corners.reshape(-1, 3), np.arange(3 * count, dtype=np.int32).reshape(-1, 3))
    points, normals = rng.uniform(-0.12, 0.12, (700, 3)), rng.normal(size=(700, 3))
    distances_m, faces = nearest_agreeing_faces(points, normals, mesh, 0.03)
    pairs = np.repeat(points, count, axis=0)
    closest = trimesh.triangles.closest_point(np.tile(corners, (len(points), 1, 1)), pairs)
    apart_m = np.linalg.norm(closest - pairs, axis=1).reshape(len(points), count)
    apart_m[(normals @ mesh.face_normals().T <= 0) | (apart_m > 0.03)] = np.inf
    assert 0.02 < np.isinf(apart_m.min(axis=1)).mean() < 0.98
    assert np.allclose(distances_m, apart_m.min(axis=1), atol=1e-9)
    assert np.array_equal(faces >= 0, np.isfinite(distances_m))
    found = faces >= 0
    assert np.allclose(apart_m[found, faces[found]], distances_m[found], atol=1e-9)


def test_far_area_is_the_share_of_the_result(rng):
    """A quarter of the result's area is 4 cm away; area that is missing in the result does not count."""
    near, far = square(0.0), square(0.04)
    far = Mesh(far.vertices * [np.sqrt(1 / 3), 1.0, np.sqrt(1 / 3)], far.faces)
    both = Mesh(np.concatenate([near.vertices, far.vertices]), np.concatenate([near.faces, near.faces + 4]))
    assert surface_scores(both, near, count=20_000)["far_area_share"] == pytest.approx(0.25, abs=0.01)
    assert surface_scores(near, both, count=2_000)["far_area_share"] == 0.0


def test_chamfer_alone_equals_that_of_all_scores():
    result, truth = square(0.01, tilt_deg=3.0), square(0.0)
    assert chamfer_distance_mm(result, truth, 500, 3) == surface_scores(result, truth, 500, seed=3)["chamfer_mm"]


def test_scores_of_a_label_are_those_of_its_part():
    """Two squares side by side, 3 and 7 mm below the result."""
    first, second = square(-0.003), square(-0.007)
    second = Mesh(second.vertices + [2.0, 0.0, 0.0], second.faces)
    truth = Mesh(np.concatenate([first.vertices, second.vertices]), np.concatenate([first.faces, first.faces + 4]))
    result = Mesh(truth.vertices * [1.0, 0.0, 1.0], truth.faces)
    found = surface_correspondence(result, truth, 4000)
    labels = np.array([5, 5, 9, 9])
    assert found.label_scores(labels, 5)["chamfer_mm"] == pytest.approx(3.0, abs=1e-6)
    assert found.label_scores(labels, 9)["chamfer_mm"] == pytest.approx(7.0, abs=1e-6)
    assert found.label_scores(labels, 9)["area_share"] == pytest.approx(0.5, abs=0.03)
    assert found.label_scores(labels, 7) is None
    missing = surface_correspondence(Mesh(result.vertices, result.faces[:2]), truth, 4000)
    assert missing.label_scores(labels, 9)["chamfer_mm"] > 1000.0
    assert missing.label_scores(labels, 9)["normal_angle_deg"] == 90.0


@pytest.mark.parametrize(("height_m", "f_score"), [(0.0049, 1.0), (0.0051, 0.0)])
def test_the_threshold_is_five_millimetres(height_m, f_score):
    assert surface_scores(square(height_m), square(0.0), count=100)["f_score"] == f_score


def test_a_missing_half_changes_the_scores_of_one_direction():
    """Half of the points of the whole are on the remaining half, the others are 0 to 500 mm away from it, uniformly."""
    whole = square(0.0)
    half = Mesh(whole.vertices * [0.5, 1.0, 1.0] - [0.25, 0.0, 0.0], whole.faces)
    missing, added = (surface_scores(*pair, count=20_000) for pair in ((half, whole), (whole, half)))
    near = 0.505  # the half and the 5 mm next to it
    for scores, (perfect, partial), (none, far) in (
        (missing, ("precision", "recall"), ("result_to_truth_mm", "truth_to_result_mm")),
        (added, ("recall", "precision"), ("truth_to_result_mm", "result_to_truth_mm")),
    ):
        assert scores[perfect] == 1.0
        assert scores[partial] == pytest.approx(near, abs=0.01)
        assert scores["f_score"] == pytest.approx(2 * near / (1 + near), abs=0.01)
        assert scores[none] == pytest.approx(0.0, abs=1e-6)
        assert scores[far] == pytest.approx(125.0, rel=0.03)
        assert scores["chamfer_mm"] == pytest.approx(62.5, rel=0.03)
        assert scores["hausdorff95_mm"] == pytest.approx(450.0, abs=8.0)  # a tenth of the missing half is farther away


def test_distances_agree_with_a_brute_force_search(rng):
    mesh = Mesh(rng.normal(size=(12, 3)), rng.permutation(12)[:12].reshape(4, 3).astype(np.int32))
    points = rng.normal(size=(20, 3))
    distances_m, faces, _ = closest_points_on_mesh(points, mesh)
    steps = np.linspace(0, 1, 201)
    u, v = np.meshgrid(steps, steps)
    inside = u + v <= 1 + 1e-12
    u, v = u[inside], v[inside]
    for point, distance_m, face in zip(points, distances_m, faces, strict=True):
        each = []
        for a, b, c in mesh.vertices[mesh.faces]:
            samples = a + u[:, None] * (b - a) + v[:, None] * (c - a)
            each.append(np.linalg.norm(samples - point, axis=1).min())
        assert distance_m == pytest.approx(min(each), abs=0.02)  # the resolution of the search
        assert each[face] == pytest.approx(min(each), abs=0.02)


def test_samples_are_on_their_faces_and_uniform_by_area():
    big_and_small = Mesh(
        np.array([[0, 0, 0], [3.0, 0, 0], [0, 3, 0], [0, 0, 5], [1, 0, 5], [0, 1, 5]]),
        np.array([[0, 1, 2], [3, 4, 5]], dtype=np.int32),
    )
    points, faces = sample_surface(big_and_small, 10_000)
    assert np.mean(faces == 0) == pytest.approx(0.9, abs=0.02)
    assert np.allclose(points[:, 2], np.where(faces == 0, 0.0, 5.0))
    assert np.allclose(
        points[faces == 0].mean(axis=0), [1.0, 1.0, 0.0], atol=0.05
    )  # the centroid: uniformly distributed
    assert np.array_equal(points, sample_surface(big_and_small, 10_000)[0])
    with pytest.raises(ValueError, match="no area"):
        sample_surface(Mesh(np.zeros((3, 3)), np.array([[0, 1, 2]], dtype=np.int32)), 10)


def test_joint_error_of_a_translation(rng):
    joints_m = rng.normal(size=(4, 7, 3))
    assert mpjpe_m(joints_m + [0.03, 0.0, 0.04], joints_m) == pytest.approx(0.05)
