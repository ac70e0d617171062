"""Turns counted from noisy yaws, and the parts of a recording that are held out for them."""

import numpy as np
import pytest

from pipeline.capture.disjoint_split import assign_disjoint_splits, cumulative_turns
from pipeline.capture.frame_selection import HELDOUT, TRAIN, UNUSED, VALIDATION


def turning(count: int, turns: float) -> np.ndarray:
    return 2 * np.pi * turns * np.arange(count) / count


@pytest.mark.parametrize("turns", [3.0, -3.0, 2.0, 1.0, 0.4])
def test_turns_are_counted_in_both_directions(turns):
    found = cumulative_turns(turning(240, turns))
    assert found[-1] == pytest.approx(abs(turns) * 239 / 240, abs=0.02)
    assert (np.diff(found) >= 0).all()
    assert found[0] == 0


def test_confused_frames_and_missing_ones_do_not_change_the_count():
    """Front and back are confused in single frames and in a run of three; a tenth of the frames has no yaw."""
    rng = np.random.default_rng(4)
    yaw = turning(240, 3.0) + rng.normal(0, 0.1, 240)
    yaw[[20, 50, 90, 91, 92, 200]] += np.pi
    yaw[rng.choice(240, 24, replace=False)] = np.nan
    assert cumulative_turns(np.angle(np.exp(1j * yaw)))[-1] == pytest.approx(3.0, abs=0.1)


def test_turning_back_does_not_count():
    """Half a turn to each side and back: at most half a turn from the start."""
    yaw = np.pi * np.sin(np.linspace(0, 2 * np.pi, 200))
    assert cumulative_turns(yaw)[-1] < 0.6
    assert assign_disjoint_splits(np.arange(200), yaw).held_out_part == "the last quarter"


@pytest.mark.parametrize(
    ("turns", "part", "share"),
    [
        (3.0, "the last of 3 turns", 1 / 3),
        (2.0, "the last of 2 turns", 1 / 2),
        (1.93, "the last of 2 turns", 1 / 2),
        (1.6, "the last quarter", 1 / 4),
        (0.0, "the last quarter", 1 / 4),
    ],
)
def test_the_part_that_is_held_out(turns, part, share):
    index = np.arange(0, 900, 3)
    found = assign_disjoint_splits(index, turning(300, turns))
    assert found.held_out_part == part
    heldout, unused = np.flatnonzero(found.split == HELDOUT), np.flatnonzero(found.split == UNUSED)
    assert len(heldout) == pytest.approx(300 * share, abs=3)
    np.testing.assert_array_equal(heldout, range(heldout[0], 300))
    np.testing.assert_array_equal(unused, range(heldout[0] - 12, heldout[0]))  # 4 % of the frames
    learnt = found.split[: unused[0]]
    np.testing.assert_array_equal(learnt == VALIDATION, index[: unused[0]] % 8 == 4)
    assert set(learnt.tolist()) == {TRAIN, VALIDATION}


def test_a_slow_last_turn_is_held_out_whole():
    """Two turns, the second at half the speed: two thirds of the frames."""
    yaw = 2 * np.pi * np.concatenate([np.arange(100) / 100, 1 + np.arange(200) / 200])
    assert (assign_disjoint_splits(np.arange(300), yaw).split == HELDOUT).sum() == pytest.approx(200, abs=4)


def test_without_any_yaw_the_last_quarter_is_held_out():
    found = assign_disjoint_splits(np.arange(40), np.full(40, np.nan))
    assert (found.turns, found.held_out_part) == (0.0, "the last quarter")
    assert (found.split == HELDOUT).sum() == 10
