"""How many training frames the field takes, for motions whose poses are known."""

import numpy as np
import pytest

from pipeline.body.body import Body, Motion
from pipeline.field.training_frames import (
    MIN_TRAINING_FRAMES,
    choose_training_frames,
    count_distinct_poses,
    pose_distances_m,
)


def turn(body: Body, angles_rad: np.ndarray) -> Motion:
    """The A-pose, turned about the vertical through the root joint, a step farther to the side in each frame."""
    rotations = np.zeros((len(angles_rad), len(body.joint_names), 4), np.float32)
    rotations[..., 0] = 1
    rotations[:, 0, 0], rotations[:, 0, 2] = np.cos(angles_rad / 2), np.sin(angles_rad / 2)
    index = np.arange(len(angles_rad), dtype=np.int32)
    return Motion(
        index, index / 30, rotations, np.stack([0.1 * index, 0 * index, 0 * index - 3.0], 1).astype(np.float32)
    )


def test_distances_of_a_turn_are_chords_about_the_axis(body: Body):
    angles = np.radians([0.0, 5.0, 60.0, 180.0])
    from_axis_m = (body.vertices - body.joints_m[0])[:, [0, 2]]
    radius_m = np.sqrt((from_axis_m**2).sum(1).mean())
    chords_m = 2 * np.abs(np.sin((angles[:, None] - angles) / 2)) * radius_m
    np.testing.assert_allclose(pose_distances_m(body, turn(body, angles)), chords_m, rtol=0.06, atol=1e-6)


def test_a_pose_counts_once():
    there_and_back = np.array([0.0, 1.0, 2.0, 3.0, 2.0, 1.0, 0.0, 0.4])
    distance_m = np.abs(there_and_back[:, None] - there_and_back)
    assert count_distinct_poses(distance_m, 0.5) == 4
    assert count_distinct_poses(distance_m, 1.0) == 2
    assert count_distinct_poses(distance_m, 9.0) == 1


@pytest.mark.parametrize(
    ("turns", "max_frames", "spacing_m", "expected"),
    [(1, 90, 0.0, 90), (3, 90, 0.0, 90), (1, 10, 0.0, 10), (1, 90, 9.0, MIN_TRAINING_FRAMES), (1, 10, 9.0, 10)],
)
def test_limits(body: Body, turns: int, max_frames: int, spacing_m: float, expected: int):
    motion = turn(body, np.linspace(0, 2 * np.pi * turns, 90, endpoint=False))
    assert len(choose_training_frames(body, motion, max_frames, spacing_m)) == expected


def test_further_turns_add_no_frames_and_these_are_spread_over_all(body: Body):
    one, three = (turn(body, np.linspace(0, 2 * np.pi * turns, 90 * turns, endpoint=False)) for turns in (1, 3))
    once, often = (choose_training_frames(body, motion, 120, 0.03) for motion in (one, three))
    assert MIN_TRAINING_FRAMES < len(once) < 90
    assert len(often) == len(once)
    assert (often[0], often[-1]) == (0, 269)
