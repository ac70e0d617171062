"""Surface distances against closed forms and against a brute-force search."""

import numpy as np
import pytest
import trimesh

from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import closest_on_mesh
from pipeline.metrics.surfaces import joint_error_m, sample_surface, surface_scores


def sphere(radius_m: float) -> Mesh:
    made = trimesh.creation.icosphere(subdivisions=4, radius=radius_m)
    return Mesh(np.asarray(made.vertices), np.asarray(made.faces, dtype=np.int32))


def square(height_m: float, tilt_deg: float = 0.0) -> Mesh:
    slope = np.tan(np.radians(tilt_deg))
    corners = np.array([[x, height_m + slope * x, z] for x in (-0.5, 0.5) for z in (-0.5, 0.5)])
    return Mesh(corners, np.array([[0, 1, 2], [2, 1, 3]], dtype=np.int32))


def test_concentric_spheres_are_apart_by_the_difference_of_their_radii():
    scores = surface_scores(sphere(0.503), sphere(0.5), count=20_000)
    for name in ("result_to_truth_mm", "truth_to_result_mm", "chamfer_mm", "hausdorff95_mm"):
        assert scores[name] == pytest.approx(3.0, abs=0.1)  # facets of the icosphere lie 0.2 mm inside at most
    assert scores["f_score"] == 1.0
    assert scores["normal_angle_deg"] < 2.0
    assert surface_scores(sphere(0.51), sphere(0.5), count=2_000)["f_score"] == 0.0


def test_tilted_square_has_the_tilt_as_normal_angle():
    scores = surface_scores(square(0.0, tilt_deg=10.0), square(0.0), count=5_000)
    assert scores["normal_angle_deg"] == pytest.approx(10.0, abs=1e-6)


def test_missing_half_shows_in_recall_only():
    whole = square(0.0)
    half = Mesh(whole.vertices * [0.5, 1.0, 1.0] - [0.25, 0.0, 0.0], whole.faces)
    scores = surface_scores(half, whole, count=20_000)
    assert scores["precision"] == 1.0
    assert scores["recall"] == pytest.approx(0.505, abs=0.01)  # half, and a 5 mm strip beside it
    assert scores["truth_to_result_mm"] == pytest.approx(125.0, rel=0.03)  # mean of 0 and of 0..500 mm, halved


def test_distances_are_those_of_a_brute_force_search(rng):
    mesh = Mesh(rng.normal(size=(12, 3)), rng.permutation(12)[:12].reshape(4, 3).astype(np.int32))
    points = rng.normal(size=(20, 3))
    distances_m, faces, _ = closest_on_mesh(points, mesh)
    steps = np.linspace(0, 1, 201)
    u, v = np.meshgrid(steps, steps)
    inside = u + v <= 1 + 1e-12
    u, v = u[inside], v[inside]
    for point, distance_m, face in zip(points, distances_m, faces, strict=True):
        each = []
        for a, b, c in mesh.vertices[mesh.faces]:
            spots = a + u[:, None] * (b - a) + v[:, None] * (c - a)
            each.append(np.linalg.norm(spots - point, axis=1).min())
        assert distance_m == pytest.approx(min(each), abs=0.02)  # the search grid is this coarse
        assert each[face] == pytest.approx(min(each), abs=0.02)


def test_samples_lie_on_their_faces_and_follow_area():
    big_and_small = Mesh(
        np.array([[0, 0, 0], [3.0, 0, 0], [0, 3, 0], [0, 0, 5], [1, 0, 5], [0, 1, 5]]),
        np.array([[0, 1, 2], [3, 4, 5]], dtype=np.int32),
    )
    points, faces = sample_surface(big_and_small, 10_000)
    assert np.mean(faces == 0) == pytest.approx(0.9, abs=0.02)
    assert np.allclose(points[:, 2], np.where(faces == 0, 0.0, 5.0))
    assert np.allclose(points[faces == 0].mean(axis=0), [1.0, 1.0, 0.0], atol=0.05)  # centroid: evenly spread
    assert np.array_equal(points, sample_surface(big_and_small, 10_000)[0])
    with pytest.raises(ValueError, match="no area"):
        sample_surface(Mesh(np.zeros((3, 3)), np.array([[0, 1, 2]], dtype=np.int32)), 10)


def test_joint_error_of_a_shift(rng):
    joints_m = rng.normal(size=(4, 7, 3))
    assert joint_error_m(joints_m + [0.03, 0.0, 0.04], joints_m) == pytest.approx(0.05)
