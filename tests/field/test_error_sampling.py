"""The error map: its update, and importance sampling from it."""

import numpy as np
import pytest
import torch

from pipeline.field.pixel_sampler import ERROR_DECAY, TILE_PX, ErrorMap, build_pixel_pool
from tests.field.scene import TRAIN, make_trainer

SIDE_PX = 4 * TILE_PX


@pytest.fixture
def pool():
    """Two frames whose mask fills four by four tiles except a margin."""
    mask = np.zeros((SIDE_PX, SIDE_PX), np.uint8)
    mask[8:-8, 8:-8] = 255
    return build_pixel_pool([(np.zeros((SIDE_PX, SIDE_PX, 3), np.uint8), mask)] * 2, border_px=2, seed=0)


def _pixels_of_one_tile(pool):
    """Two pixels of one tile, as masks over the body pixels of the second frame."""
    body = pool.xy_px[pool.start[1, 0] : pool.start[1, 1]]
    places = (TILE_PX + 1, 2 * TILE_PX), (TILE_PX + 9, 3 * TILE_PX - 1)
    return [(body == np.array(place)).all(axis=1) for place in places]


def test_the_error_of_a_tile_decays_and_other_tiles_keep_theirs(pool):
    error_map = ErrorMap(2, pool.xy_px)
    rows = np.concatenate([pool.start[1, 0] + np.flatnonzero(at) for at in _pixels_of_one_tile(pool)])
    for _ in range(3):
        error_map.update(rows, np.array([1, 1]), np.array([[0.6, 0.0, 0.0], [0.4, -0.4, 0.4]]))
    expected = 0.3 + (1 - 0.3) * ERROR_DECAY**6
    assert error_map.error[1, 2, 1] == pytest.approx(expected)
    assert np.count_nonzero(error_map.error != 1) == 1


def test_body_pixels_are_sampled_in_proportion_to_the_error(pool):
    error_map, rngs = ErrorMap(2, pool.xy_px), [np.random.default_rng(0)]
    upper = np.array([0, 1]), np.arange(4)
    error_map.error[0][np.ix_(*upper)] = 3.0
    for error_ratio, upper_fraction in ((1.0, 0.75), (0.5, 0.625), (0.0, 0.5)):
        for frame, expected in ((0, upper_fraction), (1, 0.5)):
            rows, _ = pool.sample_pixels(np.array([frame]), np.array([[8000, 0, 0]]), rngs, error_map, error_ratio)
            assert len(rows) == 8000
            for run in np.split(rows, [8000 - round(8000 * error_ratio)]):
                assert np.all(np.diff(run) >= 0)
            assert pool.start[frame, 0] <= rows.min()
            assert rows.max() < pool.start[frame, 1]
            is_upper = pool.xy_px[rows, 1] < SIDE_PX // 2
            assert is_upper.mean() == pytest.approx(expected, abs=0.02)


def test_the_error_does_not_change_the_rays_of_border_and_outside(pool):
    error_map = ErrorMap(2, pool.xy_px)
    error_map.error[:, 0] = 1e6
    sample_counts = pool.sample_counts(np.array([0, 1]), 1000.0, (0.4, 0.35, 0.25))
    assert sample_counts.tolist() == [[400, 350, 250]] * 2
    rows, _ = pool.sample_pixels(np.array([0]), sample_counts[:1], [np.random.default_rng(0)], error_map, 1.0)
    counts = np.histogram(rows, bins=[*pool.start[0]])[0]
    assert counts.tolist() == [400, 350, 250]


def test_a_frame_without_a_person_has_only_rays_outside():
    empty = np.zeros((SIDE_PX, SIDE_PX), np.uint8)
    solid = np.pad(np.full((20, 20), 255, np.uint8), 22)
    pool = build_pixel_pool([(np.zeros((64, 64, 3), np.uint8), mask) for mask in (solid, empty)], border_px=2, seed=0)
    sample_counts = pool.sample_counts(np.array([0, 1]), 100.0, (0.5, 0.3, 0.2))
    assert sample_counts[0].tolist() == [50, 30, 20]
    assert sample_counts[1, :2].tolist() == [0, 0]


@pytest.mark.slow
def test_a_resumed_training_samples_the_same_pixels(scene):
    options = {"steps": 12, "error_sampling_ratio": 0.6, "occupancy_warmup_steps": 4}
    whole, first = make_trainer(scene, **options), make_trainer(scene, **options)
    for _ in range(12):
        whole.step()
    for _ in range(5):
        first.step()
    kept = {name: value.clone() for name, value in first.state_dict().items()}
    assert float(kept["pixel_errors"].min()) < 0.9
    assert kept["pixel_errors"].shape[0] == len(TRAIN)
    second = make_trainer(scene, **options)
    second.load_state_dict(kept)
    for _ in range(7):
        second.step()
    for name, value in whole.state_dict().items():
        assert torch.equal(value, second.state_dict()[name]), name
