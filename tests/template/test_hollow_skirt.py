"""The inside of a captured skirt is cut out: what was closed at the hem is cloth of a known thickness, and legs."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from pipeline.body.body import Body, load_anny
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import (
    closest_points_on_mesh,
    count_self_intersecting_faces,
    is_closed_manifold,
    is_inside,
    isosurface,
    largest_component,
    signed_distance_m,
)
from pipeline.mesh.skin_transfer import build_skinned_topology, transfer_skin_weights
from pipeline.template.hollow_skirt import THICKNESS_M, cut_out, find_cavity, find_lining, hollow_skin, vertices_inside
from pipeline.template.regions import outer_surface
from pipeline.template.skirt import find_hem

SPACING_M, EDGE_M = 0.012, 0.012
HEM_M, WAIST_M = 0.62, 1.0
HEM_RADIUS_M, WAIST_RADIUS_M = 0.3, 0.14


def radius_m(height_m: np.ndarray) -> np.ndarray:
    """Radius of the skirt, a cone around the hips."""
    return np.interp(height_m, (HEM_M, WAIST_M), (HEM_RADIUS_M, WAIST_RADIUS_M))


@lru_cache(maxsize=3)
def filmed(
    trousers_m: float = 0.0, has_skirt: bool = True, hem_m: float = HEM_M, inner_m: float = 0.0, stump_m: float = 0.0
) -> tuple[Mesh, Body]:
    """What frames show of a person: a skirt that is solid down to its hem, and legs in trousers of a thickness.

    inner_m: by how much these are thicker between the legs. stump_m: height of what hangs below the hem, two thirds as
    wide.
    """
    model = load_anny()
    body = replace(model.at_shape(model.shape_defaults), hem_m=hem_m if has_skirt else None)
    low, high = body.vertices.min(axis=0) - 0.05, body.vertices.max(axis=0) + 0.05
    low[2], high[2] = hips_z_m(body) - 1.1 * HEM_RADIUS_M, hips_z_m(body) + 1.1 * HEM_RADIUS_M
    axes = [np.arange(first, last, SPACING_M) for first, last in zip(low, high, strict=True)]
    x, y, z = np.meshgrid(*axes, indexing="ij")
    points = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    distance_m = signed_distance_m(points, outer_surface(body)).reshape(x.shape)
    between = np.clip((leg_x_m(body, y) - np.abs(x)) / 0.03, 0.0, 1.0)
    distance_m -= (trousers_m + inner_m * between) * ((y > 0.15) & (y < WAIST_M))
    if has_skirt:
        cone_m = np.hypot(x, z - hips_z_m(body)) - radius_m(y)
        distance_m = np.minimum(distance_m, np.maximum(cone_m, np.maximum(hem_m - y, y - WAIST_M)))
        stump = np.maximum(cone_m + 0.35 * HEM_RADIUS_M, np.maximum(hem_m - stump_m - y, y - hem_m))
        distance_m = np.minimum(distance_m, stump) if stump_m else distance_m
    return largest_component(isosurface(-distance_m, 0.0, low, SPACING_M)), body


def leg_x_m(body: Body, height_m: np.ndarray) -> np.ndarray:
    """Distance of the axes of the legs from the middle."""
    ankle_m, knee_m, hip_m = (body.joints_m[body.joint(name)] for name in ("LeftFoot", "LeftLeg", "LeftUpLeg"))
    return np.interp(height_m, *np.stack([ankle_m, knee_m, hip_m])[:, [1, 0]].T)


def hips_z_m(body: Body) -> float:
    return float(body.joints_m[body.joint("LeftUpLeg"), 2])


@lru_cache(maxsize=2)
def hollow(trousers_m: float = 0.0) -> tuple[Mesh, np.ndarray]:
    """The person with a hollow skirt, and which vertices are inside of it."""
    solid, body = filmed(trousers_m)
    cavity = find_cavity(solid, transfer_skin_weights(solid, body), body, body, EDGE_M, 2000)
    found = cut_out(solid, cavity)
    return found, vertices_inside(found, cavity)


def test_a_skirt_is_hollow_and_open_at_its_hem() -> None:
    (solid, body), (found, _) = filmed(), hollow()
    assert is_closed_manifold(found)
    assert count_self_intersecting_faces(found) == 0
    angle, height_m = (
        each.ravel() for each in np.meshgrid(np.arange(0.0, 2.0 * np.pi, 0.25), np.linspace(HEM_M + 0.01, 0.72, 6))
    )
    beside_cloth_m = radius_m(height_m) - 0.03
    points = np.stack(
        [beside_cloth_m * np.sin(angle), height_m, hips_z_m(body) + beside_cloth_m * np.cos(angle)], axis=1
    )
    assert is_inside(points, solid).all()
    assert not is_inside(points, found).any()


def test_a_hem_that_is_not_where_it_is_told_is_none() -> None:
    """It is 6 cm higher. Taken for the place where the search starts, a membrane would close the skirt."""
    solid, body = filmed(stump_m=0.08)
    weights = transfer_skin_weights(solid, body)
    assert find_hem(solid, weights, body) is not None
    assert find_hem(solid, weights, replace(body, hem_m=HEM_M - 0.06)) is None


def test_cloth_has_a_thickness_and_its_outside_stays() -> None:
    (solid, body), (found, inside) = filmed(), hollow()
    height_m, out_m = solid.vertices[:, 1], np.hypot(solid.vertices[:, 0], solid.vertices[:, 2] - hips_z_m(body))
    outer = (height_m > HEM_M + 0.02) & (out_m > radius_m(height_m) - 0.004) | (height_m > WAIST_M + 0.02)
    assert closest_points_on_mesh(solid.vertices[outer], found)[0].max() < 1e-4
    at = found.vertices[find_lining(found, inside).vertices].astype(np.float64)
    at = at[at[:, 1] < 0.8]
    thickness_m = radius_m(at[:, 1]) - np.hypot(at[:, 0], at[:, 2] - hips_z_m(body))
    assert len(at) > 50
    assert np.median(thickness_m) == pytest.approx(THICKNESS_M, abs=0.004)
    assert np.quantile(np.abs(thickness_m - THICKNESS_M), 0.95) < 0.01


def test_the_ledge_around_the_filmed_legs_is_not_inside() -> None:
    """The floor of the cavity is below the hem, where frames show the legs."""
    found, inside = hollow(0.02)
    centre_m = found.vertices[found.faces].mean(axis=1)
    ledge = (found.face_normals()[:, 1] > 0.9) & (centre_m[:, 1] < HEM_M - 0.02) & (centre_m[:, 1] > 0.3)
    assert ledge.sum() > 10
    assert not inside[found.faces[ledge]].all(axis=1).any()
    assert inside[found.vertices[:, 1] > HEM_M].any()


def hidden_legs(body: Body) -> np.ndarray:
    """The vertices of legs in the skirt that are not between the thighs."""
    names = ("LeftUpLeg", "RightUpLeg", "LeftLeg", "RightLeg")
    of_legs = body.skin_weights[:, [body.joint(name) for name in names]].sum(axis=1) > 0.9
    height_m = body.vertices[:, 1]
    hidden = of_legs & (np.abs(body.vertices[:, 0]) > 0.06) & (height_m > HEM_M + 0.02) & (height_m < 0.75)
    assert hidden.sum() > 100
    return hidden


@pytest.mark.parametrize("trousers_m", [0.0, 0.02])
def test_legs_go_on_in_the_skirt_with_what_is_worn_below_it(trousers_m: float) -> None:
    (solid, body), (found, _) = filmed(trousers_m), hollow(trousers_m)
    hidden = hidden_legs(body)
    worn = body.vertices[hidden] + trousers_m * body.mesh().vertex_normals()[hidden]
    assert np.quantile(closest_points_on_mesh(worn, found)[0], 0.9) < 0.008
    # In the solid skirt these places are deep inside.
    assert np.median(signed_distance_m(worn, solid)) < -0.03


def test_legs_that_were_fitted_too_thick_are_as_thick_as_below_the_hem() -> None:
    solid, body = filmed()
    thick = replace(body, vertices=(body.vertices + 0.01 * body.mesh().vertex_normals()).astype(np.float32))
    cavity = find_cavity(solid, transfer_skin_weights(solid, body), body, thick, EDGE_M, 2000)
    assert cavity is not None
    at_m = closest_points_on_mesh(body.vertices[hidden_legs(body)], cut_out(solid, cavity))[0]
    assert np.quantile(at_m, 0.9) < 0.008


def test_the_outer_sides_of_legs_tell_what_is_worn() -> None:
    """What fills the gap between legs that stand side by side is no trousers."""
    solid, body = filmed(inner_m=0.03)
    cavity = find_cavity(solid, transfer_skin_weights(solid, body), body, body, EDGE_M, 2000)
    assert cavity is not None
    legs = body.vertices[hidden_legs(body)]
    outer = legs[np.abs(legs[:, 0]) > leg_x_m(body, legs[:, 1]) + 0.02]
    assert np.quantile(closest_points_on_mesh(outer, cut_out(solid, cavity))[0], 0.9) < 0.006


def test_both_sides_of_the_cloth_belong_together() -> None:
    found, inside = hollow()
    lining = find_lining(found, inside)
    assert inside[lining.vertices].all()
    assert not inside[lining.corners].any()
    outer_m = lining.of_outer_side(found.vertices.astype(np.float64))
    assert np.linalg.norm(outer_m - found.vertices[lining.vertices], axis=1).max() < 0.02
    legs = np.setdiff1d(np.flatnonzero(inside), lining.vertices)
    near_axis = np.abs(np.abs(found.vertices[legs, 0]) - 0.1) < 0.1
    assert (near_axis & (found.vertices[legs, 1] < 0.7)).sum() > 20


@pytest.mark.parametrize("hem_m", [0.78, pytest.param(0.25, marks=pytest.mark.slow)])
def test_short_and_long_skirts_are_hollow(hem_m: float) -> None:
    """A hand below the crotch, and over the ankles."""
    solid, body = filmed(hem_m=hem_m)
    cavity = find_cavity(solid, transfer_skin_weights(solid, body), body, body, EDGE_M, 2000)
    assert cavity is not None
    height_m = np.linspace(hem_m + 0.01, hem_m + 0.04, 4)
    beside_cloth = np.stack([0.0 * height_m, height_m, hips_z_m(body) + radius_m(height_m) - 0.03], axis=1)
    assert is_inside(beside_cloth, solid).all()
    assert not is_inside(beside_cloth, cut_out(solid, cavity)).any()


def test_a_person_without_a_skirt_stays_as_filmed() -> None:
    mesh, body = filmed(has_skirt=False)
    weights = transfer_skin_weights(mesh, body)
    assert find_cavity(mesh, weights, body, body, EDGE_M, 2000) is None
    # Masks may tell a hem, but the surface has none.
    assert find_cavity(mesh, weights, replace(body, hem_m=HEM_M), body, EDGE_M, 2000) is None


def test_faces_are_limited() -> None:
    solid, body = filmed()
    cavity = find_cavity(solid, transfer_skin_weights(solid, body), body, body, EDGE_M, 600)
    assert cavity is not None
    assert len(cavity.faces) <= 600
    found = cut_out(solid, cavity, len(solid.faces) - 200)
    assert len(found.faces) <= len(solid.faces) - 200
    assert is_closed_manifold(found)


def test_the_outside_moves_as_before_and_the_lining_with_it() -> None:
    """The solid skirt is given skin weights that tell heights and sides; legs have those of the body."""
    (solid, body), (found, inside) = filmed(), hollow()
    joints = [body.joint(name) for name in ("Hips", "LeftUpLeg", "RightUpLeg")]
    share = np.clip((solid.vertices[:, [1]] - HEM_M) / (WAIST_M - HEM_M), 0.0, 1.0)
    sides = np.clip(0.5 + solid.vertices[:, [0]], 0.0, 1.0)
    given = np.zeros((len(solid.vertices), len(body.joint_names)), np.float32)
    given[:, joints] = np.concatenate([share, (1.0 - share) * sides, (1.0 - share) * (1.0 - sides)], axis=1)
    skin = hollow_skin(found, solid, build_skinned_topology(solid, torch.from_numpy(given)), body, inside)
    weights, lining = skin.weights.numpy(), find_lining(found, inside)
    nearest_m, nearest = cKDTree(solid.vertices).query(found.vertices)
    same = nearest_m == 0.0
    assert same.sum() > 1000
    np.testing.assert_allclose(weights[same], given[nearest[same]], atol=1e-6)
    np.testing.assert_allclose(weights[lining.vertices], lining.of_outer_side(weights), atol=0.02)
    legs = np.setdiff1d(np.flatnonzero(inside & (nearest_m > 0.03)), lining.vertices)
    of_legs = weights[legs][:, [k for k, name in enumerate(body.joint_names) if "Leg" in name]].sum(axis=1)
    assert np.median(of_legs[found.vertices[legs, 1] < 0.7]) > 0.9
