"""The choice of frames: properties that must hold for any recording, and small cases worked by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.capture import frame_selection as selection


def test_split_rule():
    index = np.arange(24)
    split = selection.assign_splits(index)
    np.testing.assert_array_equal(index[split == selection.HELDOUT], [0, 8, 16])
    np.testing.assert_array_equal(index[split == selection.VALIDATION], [4, 12, 20])
    assert (split == selection.TRAIN).sum() == 18


@pytest.mark.parametrize(("repeats", "first"), [(2, 0), (2, 1), (4, 0), (4, 3)])
def test_split_of_a_file_that_repeats_its_frames(repeats, first):
    """15 or 7.5 images a second in a file of 30: an index rule would leave no validation frames, or half of them."""
    split = selection.assign_splits(np.arange(first, 320, repeats))
    for kind in (selection.HELDOUT, selection.VALIDATION):
        assert (split == kind).mean() == pytest.approx(1 / 8, abs=0.02)


def test_ranges_join_neighbours_among_the_frames():
    index = np.array([0, 3, 6, 9, 12, 40])
    assert selection.runs_of(np.array([1, 0, 1, 1, 1, 0], dtype=bool)) == [(0, 1), (2, 5)]
    assert selection.format_frame_ranges(index, np.array([1, 0, 1, 1, 1, 0], dtype=bool)) == "0, 6-12"
    assert selection.format_frame_ranges(index, np.zeros(6, dtype=bool)) == ""
    assert selection.format_frame_ranges(index, np.ones(6, dtype=bool)) == "0-40"


def moving_square(n: int, step: int) -> tuple[np.ndarray, np.ndarray]:
    person_masks = np.zeros((n, 64, 96), bool)
    for i in range(n):
        person_masks[i, 10:50, 5 + step * i : 25 + step * i] = True
    noise = np.random.default_rng(0).integers(0, 2, person_masks.shape)
    return (np.where(person_masks, 180, 60) + noise).astype(np.uint8), person_masks


def test_noise_is_measured_where_nothing_moves():
    still = np.random.default_rng(1).normal(100, 4, (9, 64, 96)).astype(np.uint8)
    expected = 4 * 2 / np.sqrt(np.pi)
    assert selection.estimate_noise_level(still) == pytest.approx(expected, rel=0.1)
    still[:, :32, :20] = (np.arange(9) * 25)[:, None, None]
    assert selection.estimate_noise_level(still) == pytest.approx(expected, rel=0.15)


def test_noise_is_never_below_rounding():
    assert selection.estimate_noise_level(np.zeros((3, 64, 64), np.uint8)) == pytest.approx(1 / 3)
    assert selection.estimate_noise_level(np.zeros((1, 64, 64), np.uint8)) == pytest.approx(1 / 3)
    assert selection.estimate_noise_level(np.zeros((3, 8, 8), np.uint8)) == pytest.approx(1 / 3)


def test_repeated_frames_are_dropped_and_motion_is_kept():
    gray_thumbnails, person_masks = moving_square(6, step=3)
    repeat = np.array([0, 0, 1, 2, 2, 2, 3, 4, 5])
    distinct, cumulative_motion = selection.find_distinct_frames(
        gray_thumbnails[repeat], person_masks[repeat], threshold=3.0
    )
    np.testing.assert_array_equal(distinct, [1, 0, 1, 1, 0, 0, 1, 1, 1])
    assert (np.diff(cumulative_motion) >= 0).all()
    assert cumulative_motion[1] == cumulative_motion[0] == 0
    assert cumulative_motion[5] == cumulative_motion[3] < cumulative_motion[6]


def test_slow_motion_adds_up_until_a_frame_counts():
    gray_thumbnails, person_masks = moving_square(20, step=1)
    one_step = selection.mean_absolute_difference(
        gray_thumbnails[0], gray_thumbnails[1], person_masks[0] | person_masks[1]
    )
    distinct, _ = selection.find_distinct_frames(gray_thumbnails, person_masks, threshold=1.5 * one_step)
    np.testing.assert_array_equal(np.flatnonzero(distinct), np.arange(0, 20, 2))


def test_change_without_a_person_is_zero():
    gray = np.zeros((4, 4), np.uint8)
    assert selection.mean_absolute_difference(gray, gray + np.uint8(9), np.zeros((4, 4), bool)) == 0


@given(st.integers(20, 300), st.integers(16, 120), st.integers(0, 2**31))
def test_selection_covers_motion_range_and_keeps_split(n, max_frames, seed):
    rng = np.random.default_rng(seed)
    frame_index = np.sort(rng.choice(4 * n, n, replace=False)).astype(np.int32)
    cumulative_motion = np.cumsum(rng.exponential(size=n))
    split = selection.assign_splits(frame_index)
    chosen = selection.select_frames_by_motion(split, cumulative_motion, max_frames)
    assert chosen.sum() <= max_frames
    for kind, quota in (
        (0, max_frames - 2 * round(max_frames / 8)),
        (1, round(max_frames / 8)),
        (2, round(max_frames / 8)),
    ):
        members = np.flatnonzero(split == kind)
        assert chosen[members].sum() == min(len(members), quota)
        if len(members) and quota > 1:
            assert chosen[members[[0, -1]]].all()


def test_selection_is_uniform_in_motion_not_in_time():
    split = selection.assign_splits(np.arange(800, dtype=np.int32))
    cumulative_motion = np.concatenate([np.linspace(0, 10, 600), np.linspace(10, 100, 201)[1:]])
    chosen = cumulative_motion[selection.select_frames_by_motion(split, cumulative_motion, 80)]
    assert (chosen > 10).mean() == pytest.approx(0.9, abs=0.03)


@pytest.mark.parametrize("yaw_deg", [0, 45, 90, 180, -90])
def test_yaw_of_a_turned_torso(yaw_deg):
    """The left shoulder of a person who faces the camera is at +x; turning its left side away moves it to +z."""
    yaw = np.radians(yaw_deg)
    world = np.zeros((1, 33, 3), np.float32)
    left = np.array([np.cos(yaw), 0, np.sin(yaw)])
    world[0, 11], world[0, 12] = 0.2 * left - [0, 0.5, 0], -0.2 * left - [0, 0.5, 0]
    world[0, 23], world[0, 24] = 0.1 * left, -0.1 * left
    difference = selection.body_yaw_rad(world)[0] - yaw
    assert np.cos(difference) == pytest.approx(1, abs=1e-6)


def test_poor_frames_are_replaceable_where_others_show_the_same_side():
    """A turn in steps of 5 degrees whose first quarter is poor: only its ends have three good neighbours."""
    yaw_rad = np.radians(np.arange(0.0, 360.0, 5.0))
    is_poor = yaw_rad < np.radians(89.0)
    np.testing.assert_array_equal(np.flatnonzero(selection.find_replaceable(yaw_rad, is_poor)), [0, 17])
    again = np.concatenate([yaw_rad, yaw_rad + 2.0 * np.pi])  # a second turn, all good
    poor_once = np.concatenate([is_poor, np.zeros(72, bool)])
    np.testing.assert_array_equal(selection.find_replaceable(again, poor_once), poor_once)
    unknown = np.where(is_poor, np.nan, yaw_rad)
    assert not selection.find_replaceable(unknown, is_poor).any()


def test_widest_unseen_arc():
    assert selection.largest_yaw_gap_rad(np.radians([0.0, 90, 200, 350])) == pytest.approx(np.radians(150))
    assert selection.largest_yaw_gap_rad(np.array([1.0])) == pytest.approx(2 * np.pi)
    assert selection.largest_yaw_gap_rad(np.array([np.nan])) == pytest.approx(2 * np.pi)


def test_repeats_are_found_without_masks_and_motion_adds_up():
    random = np.random.default_rng(2)
    thumbnails = np.repeat(random.integers(60, 200, (1, 48, 64)).astype(np.uint8), 6, axis=0)
    thumbnails[2:, 16:32, 16:32] += 12  # one block of twelve moves once
    thumbnails[4:, :16, :16] += 24
    noisy = thumbnails + random.integers(0, 2, thumbnails.shape).astype(np.uint8)
    repeats, motion = selection.find_repeats(noisy, 1.0)
    assert repeats.tolist() == [False, True, False, True, False, True]
    np.testing.assert_allclose(motion[[2, 4]], [1.0, 3.0], atol=1.2)
    assert (np.diff(motion)[[0, 2, 4]] == 0.0).all()
