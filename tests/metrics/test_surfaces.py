"""Surface distances against closed forms and against a brute-force search."""

import numpy as np
import pytest
import trimesh

from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import closest_points_on_mesh
from pipeline.metrics.surfaces import mpjpe_m, sample_surface, surface_scores


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
    scores = surface_scores(square(0.0, tilt_deg=10.0), square(0.0), count=5_000)
    assert scores["normal_angle_deg"] == pytest.approx(10.0, abs=1e-6)


def test_normal_angle_is_the_mean_of_both_directions():
    """The truth has an additional square at 60 degrees to the first, which is half of its area."""
    floor, slope = square(0.0), np.radians(60.0)
    across = floor.vertices[:, :1] + 0.5
    wall = np.concatenate([0.5 + across * np.cos(slope), across * np.sin(slope), floor.vertices[:, 2:]], axis=1)
    both = Mesh(np.concatenate([floor.vertices, wall]), np.concatenate([floor.faces, floor.faces + 4]))
    assert surface_scores(floor, both, count=20_000)["normal_angle_deg"] == pytest.approx((0 + 30) / 2, abs=0.3)


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
