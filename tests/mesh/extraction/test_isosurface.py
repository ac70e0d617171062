"""Extraction from analytic densities around a capsule: empty interiors, floaters, concavities and hands."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from pipeline.body.body import Body
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import is_closed_manifold
from pipeline.mesh.extraction.isosurface import (
    SURFACE_ISOVALUE,
    extract_mesh,
    fill_trousers,
    hand_skin_weights,
    indicator_grid,
    sample_canonical_grid,
    select_isovalue,
)
from tests.mesh.capsule import BOUNDS_M, RADIUS_M, SETTINGS, VOXEL_SIZE_M, capsule_body, capsule_distance, shell_density
from tests.mesh.extraction.two_legs import CROTCH_M, LEG_RADIUS_M, LEG_X_M, leg_grid

WITHOUT_HANDS = replace(SETTINGS, hands_from_body=False)


@pytest.fixture(scope="module")
def body() -> Body:
    return capsule_body()


def test_a_hollow_density_gives_one_solid_with_its_outer_surface(body: Body) -> None:
    samples = sample_canonical_grid(shell_density, BOUNDS_M, body, VOXEL_SIZE_M, WITHOUT_HANDS)
    mesh = extract_mesh(samples, 50.0, SETTINGS)
    assert is_closed_manifold(mesh)
    assert len(mesh.vertices) - len(mesh.faces) // 2 == 2  # genus 0: no floater, no inner surface
    np.testing.assert_allclose(capsule_distance(mesh.vertices), 0.14, atol=0.016)


def test_without_density_the_surface_is_that_of_the_body_core(body: Body) -> None:
    samples = sample_canonical_grid(lambda points: torch.zeros(len(points)), BOUNDS_M, body, 0.01, WITHOUT_HANDS)
    mesh = extract_mesh(samples, 50.0, WITHOUT_HANDS)
    assert is_closed_manifold(mesh)
    # The depth is computed on samples 0.02 m apart, with an error of half that distance.
    np.testing.assert_allclose(capsule_distance(mesh.vertices), RADIUS_M - SETTINGS.solid_core_depth_m, atol=0.015)


def test_hands_are_those_of_the_body(body: Body) -> None:
    samples = sample_canonical_grid(shell_density, BOUNDS_M, body, VOXEL_SIZE_M, SETTINGS)
    mesh = extract_mesh(samples, 50.0, SETTINGS)
    hand, trunk = (
        capsule_distance(mesh.vertices[part]) for part in (mesh.vertices[:, 0] > 0.2, mesh.vertices[:, 0] < -0.1)
    )
    np.testing.assert_allclose(hand, RADIUS_M, atol=0.01)
    np.testing.assert_allclose(trunk, 0.14, atol=0.016)


def test_concavities_are_filled_inside_the_body_only(body: Body) -> None:
    """A hole with a diameter of 4 cm through the trunk is filled; in the thick clothing around it the hole stays."""

    def density_with_hole(points: Tensor) -> Tensor:
        distance = torch.from_numpy(capsule_distance(points.numpy().astype(np.float64)))
        hole = (points[:, [0, 2]] - torch.tensor([-0.15, 0.0])).norm(dim=1) < 0.02
        return torch.where((distance < 0.16) & ~hole, 300.0, 0.0).float()

    settings = replace(WITHOUT_HANDS, solid_core_depth_m=0.2, blur_sigma_voxels=0.0)
    samples = sample_canonical_grid(density_with_hole, BOUNDS_M, body, 0.01, settings)
    column = ((np.array([-0.15, 0.5, 0.0]) - samples.origin_m) / 0.01).round().astype(int)
    heights = samples.origin_m[1] + 0.01 * np.arange(samples.density.shape[1]) - 0.5
    for closing_radius_m, filled_to in ((0.04, RADIUS_M), (0.0, 0.0)):
        indicator = indicator_grid(samples, 50.0, replace(settings, closing_radius_m=closing_radius_m))
        value = indicator[column[0], :, column[2]]
        assert (value[np.abs(heights) < filled_to - 0.015] >= 0.5).all()
        assert (value[np.abs(heights) > filled_to + 0.015] < 0.5).all()


def test_a_void_that_narrow_openings_lead_to_is_filled(body: Body) -> None:
    """A hollow ball of hair whose top has an opening, 4 or 14 cm wide; gaps between a thin tail and the trunk stay."""

    def hair_density(opening_m: float) -> Callable[[Tensor], Tensor]:
        def density(points: Tensor) -> Tensor:
            from_middle = points - torch.tensor([-0.15, 0.66, 0.0])
            shell = (from_middle.norm(dim=1) - 0.14).abs() < 0.015
            opening = (from_middle[:, 1] > 0.0) & (from_middle[:, [0, 2]].norm(dim=1) < 0.5 * opening_m)
            tail = (points - torch.tensor([0.1, 0.5, 0.16])).abs() < torch.tensor([0.1, 0.03, 0.02])
            return torch.where((shell & ~opening) | tail.all(dim=1), 300.0, 0.0)

        return density

    bounds_m = BOUNDS_M + np.array([[0.0, 0.0, 0.0], [0.0, 0.2, 0.0]], np.float32)
    settings = replace(WITHOUT_HANDS, blur_sigma_voxels=0.0, closing_radius_m=0.0)
    for opening_m, is_filled in ((0.04, True), (0.14, False)):
        samples = sample_canonical_grid(hair_density(opening_m), bounds_m, body, 0.01, settings)
        solid = indicator_grid(samples, 50.0, settings) >= SURFACE_ISOVALUE
        void, top, gap = (
            solid[tuple(((point_m - samples.origin_m) / 0.01).round().astype(int))]
            for point_m in np.array([[-0.15, 0.7, 0.0], [-0.15, 0.79, 0.0], [0.1, 0.5, 0.12]])
        )
        assert (void, top, gap) == (is_filled, is_filled, False)


@pytest.mark.parametrize(
    ("hem_m", "slit_m", "is_filled"),
    [(None, 0.0, True), (0.1, 0.0, False), (None, 0.03, False)],
    ids=["trousers", "skirt", "open at the side"],
)
def test_trousers_are_filled_in_each_slice(hem_m: float | None, slit_m: float, is_filled: bool) -> None:
    """A tube of cloth 3 cm off each leg that is open at its hem, and at its outer side as wide as told."""
    grid, (x, y, z) = leg_grid(hem_m=hem_m)
    cloth_m = np.abs(np.hypot(np.abs(x) - LEG_X_M, z) - LEG_RADIUS_M - 0.03) - 0.006
    slit = (np.abs(x) > LEG_X_M) & (np.abs(z) < 0.5 * slit_m)
    inside = (grid.body_distance_m < 0.0) | ((cloth_m < 0.0) & ~slit & (y > 0.15) & (y < CROTCH_M))
    filled = fill_trousers(inside, grid) >= SURFACE_ISOVALUE
    void = ~inside & (np.abs(np.hypot(np.abs(x) - LEG_X_M, z) - LEG_RADIUS_M - 0.012) < 0.006)
    assert filled[void & (y > 0.2) & (y < CROTCH_M - 0.02)].all() == is_filled
    assert filled[void].any() == is_filled
    assert not filled[y < 0.13].any()


def test_hand_weights_sum_over_every_joint_of_a_hand(body: Body) -> None:
    weights = hand_skin_weights(body)
    assert weights.min() == 0.0
    assert weights.max() == 1.0


def test_cloth_far_from_the_body_is_part_of_the_surface(body: Body) -> None:
    """A skirt stands off the body by 35 cm; the grid reaches as far as the density does."""

    def density(points: Tensor) -> Tensor:
        distance = torch.from_numpy(capsule_distance(points.numpy().astype(np.float64)))
        return torch.where(distance < RADIUS_M + 0.35, 300.0, 0.0).float()

    bounds_m = np.array([[-0.8, 0.0, -0.5], [0.8, 1.0, 0.5]])
    mesh = extract_mesh(sample_canonical_grid(density, bounds_m, body, VOXEL_SIZE_M, WITHOUT_HANDS), 50.0, SETTINGS)
    np.testing.assert_allclose(capsule_distance(mesh.vertices), RADIUS_M + 0.35, atol=0.02)


def test_the_grid_covers_the_body_where_there_is_no_density(body: Body) -> None:
    nowhere_m = np.array([[0.0, 0.5, 0.0], [0.02, 0.52, 0.02]])
    samples = sample_canonical_grid(lambda points: torch.zeros(len(points)), nowhere_m, body, VOXEL_SIZE_M, SETTINGS)
    last_m = samples.origin_m + samples.spacing_m * (np.array(samples.density.shape) - 1)
    assert (samples.origin_m < body.vertices.min(axis=0)).all()
    assert (last_m > body.vertices.max(axis=0)).all()


def test_distance_is_exact_at_the_hand_and_interpolated_elsewhere(body: Body) -> None:
    samples = sample_canonical_grid(shell_density, BOUNDS_M, body, VOXEL_SIZE_M, SETTINGS)
    index = np.stack(np.meshgrid(*map(np.arange, samples.density.shape), indexing="ij"), axis=-1)
    truth = capsule_distance(index * samples.spacing_m + samples.origin_m) - RADIUS_M
    hand = (np.abs(truth) < 0.04) & (samples.hand_weight > 0)
    assert hand.sum() > 1000
    np.testing.assert_allclose(samples.body_distance_m[hand], truth[hand], atol=0.006)
    outside = (truth > 0.05) & (truth < 0.12)
    np.testing.assert_allclose(samples.body_distance_m[outside], truth[outside], atol=0.03)


def test_the_isovalue_with_the_highest_score_is_selected(body: Body) -> None:
    def ramp(points: Tensor) -> Tensor:
        distance = torch.from_numpy(capsule_distance(points.numpy().astype(np.float64))).float()
        return 100.0 * torch.exp((0.12 - distance) / 0.02)

    samples = sample_canonical_grid(ramp, BOUNDS_M, body, VOXEL_SIZE_M, WITHOUT_HANDS)

    def score(mesh: Mesh) -> float:
        return -abs(float(np.median(capsule_distance(mesh.vertices))) - 0.12)

    settings = replace(SETTINGS, isovalues_per_m=(1600.0, 400.0, 100.0, 25.0))
    isovalue_per_m, best = select_isovalue(samples, settings, score)
    assert isovalue_per_m == 100.0
    assert best > -0.01


def test_an_empty_solid_is_an_error(body: Body) -> None:
    settings = replace(WITHOUT_HANDS, solid_core_depth_m=0.2)
    samples = sample_canonical_grid(lambda points: torch.zeros(len(points)), BOUNDS_M, body, VOXEL_SIZE_M, settings)
    with pytest.raises(ValueError, match="reaches the isovalue"):
        extract_mesh(samples, 50.0, settings)
