"""Fairing: bumps go, the offset and the details of the body stay, and the smoothing follows the thickness."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import ndimage
from torch import Tensor

from pipeline.body.body import Body
from pipeline.geometry.surface import is_closed_manifold
from pipeline.mesh.extraction import fairing
from pipeline.mesh.extraction.between_legs import LegGrid
from pipeline.mesh.extraction.evidence import RingEvidence
from pipeline.mesh.extraction.fairing import SIGMAS_M, fair_surface, local_thickness_m, smooth_with_local_sigma
from pipeline.mesh.extraction.isosurface import extract_mesh, sample_canonical_grid
from pipeline.mesh.extraction.skirt_ring import CompletedSkirt
from tests.mesh.capsule import BOUNDS_M, RADIUS_M, SETTINGS, capsule_body, capsule_distance
from tests.mesh.full_evidence import full_evidence

SPACING_M, CLOTH_M, BUMP_M = 0.01, 0.03, 0.006
WITHOUT_HANDS = replace(SETTINGS, hands_from_body=False, solid_core_depth_m=0.09)


@pytest.fixture(scope="module")
def body() -> Body:
    return capsule_body()


def bumpy_cloth(points: Tensor) -> Tensor:
    """Density of cloth 3 cm off the capsule with bumps of 6 mm, 5 cm long."""
    array = points.numpy().astype(np.float64)
    waves = np.sin(array * (2.0 * np.pi / 0.05)).prod(axis=1)
    depth_m = RADIUS_M + CLOTH_M + BUMP_M * waves - capsule_distance(array)
    return torch.from_numpy(100.0 * np.exp(np.clip(depth_m / 0.004, -20.0, 20.0))).float()


def test_bumps_go_and_the_offset_of_the_cloth_stays(body: Body) -> None:
    samples = sample_canonical_grid(bumpy_cloth, BOUNDS_M, body, SPACING_M, WITHOUT_HANDS)
    settings = replace(WITHOUT_HANDS, blur_sigma_voxels=0.0)
    rough = extract_mesh(samples, 100.0, settings)
    fair = fair_surface(rough, samples, body, body.mesh(), full_evidence(body), settings)
    assert is_closed_manifold(fair)
    deviation_m = [capsule_distance(mesh.vertices) - RADIUS_M - CLOTH_M for mesh in (rough, fair)]
    assert deviation_m[0].std() > 0.0015
    assert deviation_m[1].std() < 0.5 * deviation_m[0].std()
    assert abs(deviation_m[1].mean()) < 0.001  # smoothing the surface itself would shrink it


def test_without_fairing_the_mesh_is_returned_as_it_is(body: Body) -> None:
    samples = sample_canonical_grid(bumpy_cloth, BOUNDS_M, body, 0.02, WITHOUT_HANDS)
    mesh = extract_mesh(samples, 100.0, WITHOUT_HANDS)
    assert (
        fair_surface(mesh, samples, body, body.mesh(), full_evidence(body), replace(WITHOUT_HANDS, fairing_ratio=0.0))
        is mesh
    )


def test_local_thickness_is_the_radius_of_the_part(body: Body) -> None:
    """A ball of 9 cm with an arm of 2.5 cm."""
    axis = np.arange(-0.15, 0.4501, SPACING_M)
    x, y, z = np.meshgrid(axis, axis[axis < 0.15], axis[axis < 0.15], indexing="ij")
    inside = (x**2 + y**2 + z**2 < 0.09**2) | ((np.hypot(y, z) < 0.025) & (x > 0.0) & (x < 0.4))
    thickness_m = local_thickness_m(inside, SPACING_M)
    middle = len(axis[axis < 0.15]) // 2
    ball, arm = (thickness_m[np.argmin(np.abs(axis - along)), middle, middle] for along in (0.0, 0.3))
    assert ball == pytest.approx(0.08, abs=0.005)
    assert arm == pytest.approx(0.02, abs=0.005)


def test_smoothing_with_one_sigma_is_a_gaussian_filter() -> None:
    values = np.random.default_rng(0).normal(size=(24, 24, 24))
    for sigma_m in (0.0, 0.01, 0.03):
        expected = ndimage.gaussian_filter(values, sigma_m / SPACING_M, truncate=3.0) if sigma_m else values
        result = smooth_with_local_sigma(values, np.full(values.shape, sigma_m), SPACING_M)
        np.testing.assert_allclose(result, expected, atol=1e-12)
    largest = smooth_with_local_sigma(values, np.full(values.shape, 0.5), SPACING_M)
    np.testing.assert_allclose(
        largest, ndimage.gaussian_filter(values, SIGMAS_M[-1] / SPACING_M, truncate=3.0), atol=1e-12
    )


def test_a_weighted_mean_leaves_out_what_has_no_weight() -> None:
    """Normalised convolution: a constant stays where its weight is 1, whatever lies where it is nearly 0."""
    known = np.arange(24) < 12
    values = np.where(known, 3.0, 1000.0)[:, None, None] * np.ones((24, 8, 8))
    weight = np.where(known, 1.0, 1e-9)[:, None, None] * np.ones((24, 8, 8))
    smoothed = smooth_with_local_sigma(values, np.full(values.shape, 0.02), SPACING_M, weight)
    np.testing.assert_allclose(smoothed[:16], 3.0, atol=0.01)


def test_what_no_frame_shows_is_as_far_off_the_body_as_what_is_seen_beside_it(body: Body) -> None:
    """A lump of 4 cm on the back, where no frame shows it, goes; on the front, where frames show it, it stays."""
    middle_m = 0.5 * (body.vertices.min(axis=0) + body.vertices.max(axis=0))

    def lumps(points: Tensor) -> Tensor:
        array = points.numpy().astype(np.float64)
        distance_m = capsule_distance(array)
        for side in (-1.0, 1.0):
            centre_m = middle_m + [0.0, 0.0, side * (RADIUS_M + CLOTH_M)]
            distance_m = np.minimum(distance_m, np.linalg.norm(array - centre_m, axis=1) + RADIUS_M - 0.01)
        return torch.from_numpy(100.0 * np.exp(np.clip((RADIUS_M + CLOTH_M - distance_m) / 0.004, -20.0, 20.0))).float()

    samples = sample_canonical_grid(lumps, BOUNDS_M, body, SPACING_M, WITHOUT_HANDS)
    rough = extract_mesh(samples, 100.0, WITHOUT_HANDS)
    evidence = replace(full_evidence(body), of_vertices=(body.vertices[:, 2] > middle_m[2]).astype(float))
    fair = fair_surface(rough, samples, body, body.mesh(), evidence, WITHOUT_HANDS)
    height_m = [
        [(side * (mesh.vertices[:, 2] - middle_m[2])).max() - RADIUS_M - CLOTH_M for side in (-1.0, 1.0)]
        for mesh in (rough, fair)
    ]
    assert min(height_m[0]) > 0.03
    assert height_m[1][0] < 0.008
    assert height_m[1][1] > 0.015


def test_a_completed_skirt_keeps_its_edges(body: Body, monkeypatch: pytest.MonkeyPatch) -> None:
    """A cube around the middle of the capsule takes the place of what the frames show."""
    middle_m, half_m = 0.5 * (body.vertices.min(axis=0) + body.vertices.max(axis=0)), RADIUS_M + 0.06

    def complete(surface_m: np.ndarray, grid: LegGrid, body: Body, evidence: RingEvidence) -> CompletedSkirt:
        points_m = np.moveaxis(np.indices(surface_m.shape), 0, -1) * grid.spacing_m + grid.origin_m
        cube_m = np.abs(points_m - middle_m).max(axis=-1) - half_m
        share = (cube_m < 0.03).astype(float)
        return CompletedSkirt(np.where(share > 0.0, cube_m, surface_m), share)

    monkeypatch.setattr(fairing, "complete_skirt", complete)
    samples = sample_canonical_grid(bumpy_cloth, BOUNDS_M, body, SPACING_M, WITHOUT_HANDS)
    rough = extract_mesh(samples, 100.0, WITHOUT_HANDS)
    fair = fair_surface(rough, samples, body, body.mesh(), full_evidence(body), WITHOUT_HANDS)
    corner_m = middle_m + half_m
    assert np.linalg.norm(fair.vertices - corner_m, axis=1).min() < 0.014


def test_hands_keep_the_shape_of_the_body(body: Body) -> None:
    samples = sample_canonical_grid(bumpy_cloth, BOUNDS_M, body, SPACING_M, SETTINGS)
    fair = fair_surface(
        extract_mesh(samples, 100.0, SETTINGS), samples, body, body.mesh(), full_evidence(body), SETTINGS
    )
    hand = fair.vertices[:, 0] > 0.2
    np.testing.assert_allclose(capsule_distance(fair.vertices[hand]), RADIUS_M, atol=0.004)
