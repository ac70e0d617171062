"""Pixel sampling: comparison with the reference, stratification, and sampling in proportion to the error."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from pipeline.field.pixel_sampler import posed_space_cameras
from pipeline.geometry import camera as cameras
from pipeline.geometry.camera import Camera
from pipeline.kernels.pixel_sampling import (
    CANDIDATES_PER_SAMPLE,
    PixelLists,
    SampleCounts,
    TileErrors,
    count_uniforms,
    generate_pixel_rays,
    reference,
    sample_pixels,
    update_error_map,
)

TILE_PX, SIDE = 4, 40
XY_PX = np.stack(np.meshgrid(np.arange(SIDE), np.arange(SIDE)), axis=-1).reshape(-1, 2).astype(np.int16)
OFFSETS = np.array([[0, 500, 501, 800], [800, 800, 1100, 1600]])
"""Two frames with three pixel classes: one class has a single pixel, one has none."""


def random_error_map(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).gamma(0.3, size=(2, SIDE // TILE_PX, SIDE // TILE_PX)).astype(np.float32)


def run_sampler(implementation, frames, sizes, error_sampled_sizes, error, seed=0, outlier_ratio=np.inf):
    frames, sizes, error_sampled_sizes = np.array(frames), np.array(sizes), np.array(error_sampled_sizes)
    uniforms = np.random.default_rng(seed).random(int(count_uniforms(sizes, error_sampled_sizes).sum()))
    samples = SampleCounts(frames, sizes, error_sampled_sizes)
    return implementation(PixelLists(OFFSETS, XY_PX), samples, TileErrors(error, TILE_PX, outlier_ratio), uniforms)


@given(
    st.lists(st.integers(0, 60), min_size=5, max_size=5),
    st.lists(st.integers(0, 60), min_size=5, max_size=5),
    st.integers(0, 99),
    st.sampled_from([0.5, 3.0, np.inf]),
)
def test_compiled_sampler_matches_reference(uniform, error_sampled_sizes, seed, outlier_ratio):
    frames, empty = [0, 1], 3
    error_sampled = np.insert(np.array(error_sampled_sizes), empty, 0).reshape(2, 3)
    sizes = error_sampled + np.insert(np.array(uniform), empty, 0).reshape(2, 3)
    (ours, confidence), (expected, expected_confidence) = (
        run_sampler(implementation, frames, sizes, error_sampled, random_error_map(seed), seed, outlier_ratio)
        for implementation in (sample_pixels, reference.sample_pixels)
    )
    assert ours.tolist() == expected.tolist()
    np.testing.assert_allclose(confidence, expected_confidence, rtol=1e-6)
    assert outlier_ratio < np.inf or (confidence == 1).all()
    classes = np.repeat(np.arange(6), sizes.reshape(-1))
    first, last = OFFSETS[:, :3].reshape(-1)[classes], OFFSETS[:, 1:].reshape(-1)[classes]
    assert ((ours >= first) & (ours < last)).all()


def test_samples_are_stratified():
    rows, _ = run_sampler(sample_pixels, [1], [[0, 100, 250]], [[0, 0, 0]], random_error_map(0))
    assert ((rows[:100] - 800) // 3).tolist() == list(range(100))
    assert ((rows[100:] - 1100) // 2).tolist() == list(range(250))
    assert len(set(((rows[:100] - 800) % 3).tolist())) == 3


def test_error_sampling_is_proportional_to_error():
    error = np.full((2, SIDE // TILE_PX, SIDE // TILE_PX), 1.0, np.float32)
    error[0, :2] = 3.0
    upper = XY_PX[:500, 1] < 2 * TILE_PX
    expected = 3 * upper.sum() / (3 * upper.sum() + (~upper).sum())
    rows, _ = run_sampler(sample_pixels, [0], [[4000, 0, 0]], [[4000, 0, 0]], error)
    assert upper[rows].mean() == pytest.approx(expected, abs=0.01)
    # Within a row of tiles all pixels are equally likely.
    counts = np.bincount(rows[upper[rows]], minlength=500)[:320]
    assert counts.std() < 1.2 * np.sqrt(counts.mean())
    # Without errors all pixels are equally likely.
    rows, _ = run_sampler(sample_pixels, [0], [[500, 0, 0]], [[500, 0, 0]], np.zeros_like(error))
    assert len(set(rows.tolist())) > 300
    assert np.histogram(rows, bins=5, range=(0, 500))[0].tolist() == pytest.approx([100] * 5, abs=8)


def test_outlier_tiles_are_clamped_and_get_low_confidence():
    error = np.full((2, SIDE // TILE_PX, SIDE // TILE_PX), 0.1, np.float32)
    error[0, 0, :2], error[0, 1] = 2.0, 0.3
    rows, confidence = run_sampler(sample_pixels, [0], [[8000, 0, 40]], [[4000, 0, 0]], error, outlier_ratio=4.0)
    found = error[0, XY_PX[:, 1] // TILE_PX, XY_PX[:, 0] // TILE_PX]
    # The limit is 0.4: an error of 20 medians is clamped to 4 medians, and its confidence is 1/625.
    np.testing.assert_allclose(confidence, np.where(found[rows] > 1, (0.4 / 2.0) ** 4, 1.0), rtol=1e-5)
    clamped = np.minimum(found[:500], 0.4)
    for level in (2.0, 0.3, 0.1):
        fraction = (found[rows[4000:8000]] == np.float32(level)).mean()
        assert fraction == pytest.approx(clamped[found[:500] == np.float32(level)].sum() / clamped.sum(), abs=0.01)
    # A frame without uniform samples of the first class has no median, hence no limit.
    assert (run_sampler(sample_pixels, [0], [[0, 0, 40]], [[0, 0, 0]], error, outlier_ratio=4.0)[1] == 1).all()


def test_uniform_count():
    assert count_uniforms(np.array([[5, 2], [0, 1]]), np.array([[3, 0], [0, 0]])).tolist() == [
        7 + 3 * CANDIDATES_PER_SAMPLE,
        1,
    ]


def test_rays_equal_camera_rays_in_posed_space():
    random = np.random.default_rng(0)
    rotation = np.linalg.qr(random.normal(size=(4, 3, 3)))[0]
    rotation *= np.linalg.det(rotation)[:, None, None]
    world_to_camera, world_to_posed = np.eye(4, dtype=np.float32), np.tile(np.eye(4, dtype=np.float32), (3, 1, 1))
    world_to_camera[:3] = np.concatenate([rotation[3], random.normal(size=(3, 1))], axis=1)
    world_to_posed[:, :3] = np.concatenate([rotation[:3], random.normal(size=(3, 3, 1))], axis=2)
    camera = Camera(300.0, 310.0, 21.0, 18.5, SIDE, SIDE, world_to_camera)
    rows, frame = random.integers(0, 1600, 50), np.sort(random.integers(0, 3, 50))
    inside, rgba = random.random((50, 2), dtype=np.float32), random.integers(0, 256, (1600, 4), dtype=np.uint8)
    inputs = (rows, frame, XY_PX, rgba, inside, posed_space_cameras(camera, world_to_posed))
    origins, directions, pixel_rgba = generate_pixel_rays(*inputs)
    for ours, expected in zip((origins, directions, pixel_rgba), reference.generate_pixel_rays(*inputs), strict=True):
        np.testing.assert_allclose(ours, expected, atol=1e-5)
    world = [part.numpy() for part in cameras.pixel_rays(camera, torch.from_numpy(XY_PX[rows] + inside))]
    matrix = world_to_posed[frame]
    np.testing.assert_allclose(origins, (matrix[:, :3, :3] @ world[0][..., None])[..., 0] + matrix[:, :3, 3], atol=1e-5)
    np.testing.assert_allclose(directions, (matrix[:, :3, :3] @ world[1][..., None])[..., 0], atol=1e-6)
    np.testing.assert_allclose(pixel_rgba, rgba[rows] / 255, atol=1e-7)


def test_error_map_update_matches_reference():
    random = np.random.default_rng(3)
    rows, frame = random.integers(0, 1600, 300), np.repeat([1, 0], [180, 120])
    colour_error = random.normal(size=(300, 3)).astype(np.float32)
    ours, expected = random_error_map(1), random_error_map(1)
    update_error_map(rows, frame, XY_PX, colour_error, 0.8, TILE_PX, ours)
    reference.update_error_map(rows, frame, XY_PX, colour_error, 0.8, TILE_PX, expected)
    np.testing.assert_allclose(ours, expected, rtol=1e-5)
    assert (ours != random_error_map(1)).mean() > 0.5
    before = ours.copy()
    update_error_map(rows[:0], frame[:0], XY_PX, colour_error[:0], 0.8, TILE_PX, ours)
    assert (ours == before).all()
