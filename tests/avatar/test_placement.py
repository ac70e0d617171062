"""The exported scene: floor height, origin, and the duration of the animation."""

import numpy as np
import pytest

from pipeline.avatar.placement import pad_motion_to_video, resample_uniformly, world_to_scene_translation_m
from pipeline.body.body import Motion


def motion_at(frames: list[int], positions_m: np.ndarray, time_s: list[float] | None = None) -> Motion:
    index = np.array(frames, dtype=np.int32)
    times = index / 30.0 if time_s is None else np.array(time_s)
    rotations = np.tile(np.array([1.0, 0, 0, 0], dtype=np.float32), (len(frames), 2, 1))
    rotations[:, 1, 0] = np.arange(len(frames))  # marks the source frame of a row
    return Motion(index, times, rotations, positions_m.astype(np.float32))


def test_the_floor_is_robust_to_jumps_and_one_wrong_pose() -> None:
    frames = list(range(100))
    positions_m = np.tile([0.3, 0.0, -5.0], (100, 1))
    lowest = np.full(100, -1.2)
    lowest[20:80] = -0.9  # sixty frames in the air
    lowest[5] = -2.0
    offset = world_to_scene_translation_m(motion_at(frames, positions_m), lowest)
    np.testing.assert_allclose(offset, [-0.3, 1.2, 5.0], atol=1e-6)


def test_the_animation_has_the_duration_of_the_video() -> None:
    padded = pad_motion_to_video(motion_at([4, 6, 9], np.eye(3)), frame_rate=30.0, video_frame_count=21)
    np.testing.assert_array_equal(padded.frame_index, [0, 4, 6, 9, 20])
    np.testing.assert_allclose(padded.time_s, padded.frame_index / 30.0, rtol=1e-12)
    np.testing.assert_array_equal(padded.rotations_wxyz[:, 1, 0], [0, 0, 1, 2, 2])
    np.testing.assert_array_equal(padded.root_translation_m[[0, -1]], np.eye(3)[[0, 2]])


def test_frames_keep_the_times_of_a_video_of_variable_frame_rate() -> None:
    """Frame 6 is late, frame 9 on time; the 11 missing frames at the end take 0.55 s at 20 frames per second."""
    padded = pad_motion_to_video(
        motion_at([4, 6, 9], np.eye(3), [0.13, 0.29, 0.36]), frame_rate=20.0, video_frame_count=21
    )
    np.testing.assert_allclose(padded.time_s, [0.0, 0.13, 0.29, 0.36, 0.91], rtol=1e-12)


@pytest.mark.parametrize("frames", [[0, 1, 2], [0, 7, 20]])
def test_a_complete_motion_is_not_padded(frames: list[int]) -> None:
    padded = pad_motion_to_video(motion_at(frames, np.eye(3)), frame_rate=30.0, video_frame_count=frames[-1] + 1)
    np.testing.assert_array_equal(padded.frame_index, frames)


def test_an_uneven_motion_is_sampled_along_lines_and_arcs() -> None:
    """Constant speed and constant rotation about y, at uneven times: the values at even times are known."""
    time_s = np.array([0.0, 0.1, 0.35, 0.5])
    half = 0.5 * 2.0 * time_s
    rotations = np.stack([np.cos(half), 0 * half, np.sin(half), 0 * half], axis=1).astype(np.float32)[:, None]
    rotations[2] *= -1  # the same rotation
    motion = Motion(np.array([0, 1, 2, 3]), time_s, rotations, np.outer(time_s, [1, 2, 3]).astype(np.float32))
    even = resample_uniformly(motion, 10.0)
    expected_s = np.arange(6) / 10.0
    np.testing.assert_allclose(even.time_s, expected_s, atol=1e-9)
    np.testing.assert_allclose(even.root_translation_m, np.outer(expected_s, [1, 2, 3]), atol=1e-6)
    np.testing.assert_allclose(np.abs(even.rotations_wxyz[:, 0, 2]), np.sin(expected_s), atol=1e-6)
    assert len(resample_uniformly(motion.select(np.array([1])), 10.0).time_s) == 1
