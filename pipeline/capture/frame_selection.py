"""Selection and splits of frames. Pure functions on grey thumbnails and landmarks.

The interleaved split depends on the index of a frame in the recording only, so it does not change with the selection,
unless the recording repeats its frames in step with it (`split_phases`); `pipeline.capture.disjoint_split` holds out
the end of the recording. A user-supplied split (`pipeline.capture.user_files`) replaces split and selection.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from pipeline.capture.landmarks import TORSO

TRAIN, VALIDATION, HELDOUT = 0, 1, 2
UNUSED = 3
"""Frames that are in no split; they are not selected."""

INTERLEAVED_RULE = "interleaved: every eighth frame held out"
SPLIT_PERIOD = 8
VALIDATION_PHASE = 4
MIN_SHARE, MAX_SHARE = 0.5, 1.8
"""Held-out and validation frames over an eighth of all frames: beyond these limits frames are missing in step."""
SAME_SIDE_RAD, MIN_REPLACEMENTS = np.radians(15.0), 3
"""A poor frame is left out if so many others show the person from the same side, which is within this angle."""
# Mean absolute difference of two images of the same scene when rounding to integer levels is the only noise:
# E|round(a + e1) - round(a + e2)| with independent uniform dither = 1/3.
_QUANTISATION_NOISE = 1.0 / 3.0
_BLOCK_PX = 16


def evenly_spaced(count: int, limit: int) -> Int[np.ndarray, "k"]:
    """Return at most `limit` of the indices 0..count-1, evenly spaced, including both ends."""
    return np.unique(np.linspace(0, count - 1, min(count, limit)).round().astype(np.int64))


def assign_splits(frame_index: Int[np.ndarray, "n"]) -> UInt8[np.ndarray, "n"]:
    """Return HELDOUT for phase 0 of `split_phases`, VALIDATION for phase 4, TRAIN for all others."""
    phase = split_phases(frame_index)
    return np.select([phase == 0, phase == VALIDATION_PHASE], [HELDOUT, VALIDATION], TRAIN).astype(np.uint8)


def split_phases(frame_index: Int[np.ndarray, "n"]) -> Int[np.ndarray, "n"]:
    """Return the phase of each frame in a cycle of eight: its index modulo eight.

    Where frames that repeat others are left out in step with this cycle (15 images a second in a file of 30), some
    kind of frames would be empty or too many: then it is the place among the frames modulo eight.
    """
    phase = frame_index % SPLIT_PERIOD
    shares = np.bincount(phase, minlength=SPLIT_PERIOD)[[0, VALIDATION_PHASE]] * SPLIT_PERIOD / max(1, len(phase))
    is_regular = shares.min() >= MIN_SHARE and shares.max() <= MAX_SHARE
    return phase if is_regular else np.arange(len(phase)) % SPLIT_PERIOD


def estimate_noise_level(gray_thumbnails: UInt8[np.ndarray, "n h w"]) -> float:
    """Return the mean absolute difference between successive images where nothing moves, levels of 255.

    For each pair the calmest quarter of 16 x 16 blocks is static; the result is the median over pairs, at least the
    rounding noise.
    """
    levels = []
    for first, second in zip(gray_thumbnails[:-1], gray_thumbnails[1:], strict=True):
        difference = np.abs(first.astype(np.float32) - second)
        rows, columns = (side // _BLOCK_PX * _BLOCK_PX for side in difference.shape)
        if rows == 0 or columns == 0:
            continue
        blocks = difference[:rows, :columns].reshape(rows // _BLOCK_PX, _BLOCK_PX, columns // _BLOCK_PX, _BLOCK_PX)
        levels.append(np.percentile(blocks.mean(axis=(1, 3)), 25))
    return max(_QUANTISATION_NOISE, float(np.median(levels)) if levels else 0.0)


def mean_absolute_difference(
    first: UInt8[np.ndarray, "h w"], second: UInt8[np.ndarray, "h w"], person: Bool[np.ndarray, "h w"]
) -> float:
    """Return the mean absolute difference of two grey images on the pixels of the person, levels of 255."""
    if not person.any():
        return 0.0
    return float(np.abs(first.astype(np.float32) - second)[person].mean())


def find_distinct_frames(
    gray_thumbnails: UInt8[np.ndarray, "n h w"], person_masks: Bool[np.ndarray, "n h w"], threshold: float
) -> tuple[Bool[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Return which frames differ from the last kept one by more than `threshold`, and the cumulative motion.

    Cumulative motion is the sum of differences between kept frames (levels of 255); a dropped frame has the value of
    the kept frame before it.
    """
    keep = np.zeros(len(gray_thumbnails), dtype=bool)
    cumulative_motion = np.zeros(len(gray_thumbnails), dtype=np.float64)
    last = 0
    for i in range(len(gray_thumbnails)):
        step = mean_absolute_difference(gray_thumbnails[last], gray_thumbnails[i], person_masks[last] | person_masks[i])
        keep[i] = i == 0 or step > threshold
        cumulative_motion[i] = cumulative_motion[last] + (step if keep[i] else 0.0)
        last = i if keep[i] else last
    return keep, cumulative_motion


def find_repeats(
    gray_thumbnails: UInt8[np.ndarray, "n h w"], threshold: float
) -> tuple[Bool[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Return which frames differ from the last kept one nowhere, and the cumulative motion of all.

    A frame repeats another if no block of 16 x 16 pixels differs by more than `threshold` (levels of 255), wherever the
    person is: stricter than `find_distinct_frames`, which needs masks. Motion is the mean over blocks.
    """
    repeats = np.zeros(len(gray_thumbnails), dtype=bool)
    cumulative_motion = np.zeros(len(gray_thumbnails), dtype=np.float64)
    last = 0
    for i in range(1, len(gray_thumbnails)):
        difference = cv2.absdiff(gray_thumbnails[last], gray_thumbnails[i])
        size = tuple(max(1, round(side / _BLOCK_PX)) for side in difference.shape[::-1])
        blocks = cv2.resize(difference.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        repeats[i] = blocks.max() <= threshold
        cumulative_motion[i] = cumulative_motion[last] + (0.0 if repeats[i] else float(blocks.mean()))
        last = last if repeats[i] else i
    return repeats, cumulative_motion


def select_frames_by_motion(
    split: UInt8[np.ndarray, "n"], cumulative_motion: Float[np.ndarray, "n"], max_frames: int
) -> Bool[np.ndarray, "n"]:
    """Select at most `max_frames` frames at equal steps of cumulative motion, an eighth each held out and validation.

    Equal steps of motion instead of time: a slow part of a turn gets no more frames than a fast one. Each split covers
    its whole motion by itself, including its first and last frame. UNUSED frames are not selected.
    """
    chosen = np.zeros(len(split), dtype=bool)
    share = max(1, round(max_frames / SPLIT_PERIOD))
    quotas = {HELDOUT: share, VALIDATION: share, TRAIN: max(1, max_frames - 2 * share)}
    for kind, quota in quotas.items():
        members = np.flatnonzero(split == kind)
        chosen[members[_evenly_spaced_indices(cumulative_motion[members], quota)]] = True
    return chosen


def body_yaw_rad(landmarks_world_m: Float[np.ndarray, "n 33 3"]) -> Float[np.ndarray, "n"]:
    """Return the yaw of the torso: 0 facing the camera, pi / 2 with the left side away from the camera.

    It is computed from the lines through shoulders and hips, in camera axes (x right, y down, z forward).
    """
    left_shoulder, right_shoulder, left_hip, right_hip = (landmarks_world_m[:, index] for index in TORSO)
    leftward = left_shoulder - right_shoulder + left_hip - right_hip
    return np.arctan2(leftward[:, 2], leftward[:, 0])


def find_replaceable(yaw_rad: Float[np.ndarray, "n"], is_poor: Bool[np.ndarray, "n"]) -> Bool[np.ndarray, "n"]:
    """Return the poor frames that others replace, because they show the person from the same side.

    yaw_rad: of the torso, from `body_yaw_rad`; nan where unknown.
    """
    apart_rad = np.abs(np.angle(np.exp(1j * (yaw_rad[:, None] - yaw_rad[None, ~is_poor]))))
    return is_poor & ((apart_rad <= SAME_SIDE_RAD).sum(axis=1) >= MIN_REPLACEMENTS)


def largest_yaw_gap_rad(yaw_rad: Float[np.ndarray, "n"]) -> float:
    """Return the largest arc of the circle without any yaw, in (0, 2 pi]."""
    angles = np.sort(np.mod(yaw_rad[np.isfinite(yaw_rad)], 2 * np.pi))
    if len(angles) == 0:
        return 2 * np.pi
    return float(np.diff(np.append(angles, angles[0] + 2 * np.pi)).max())


def runs_of(flags: Bool[np.ndarray, "n"]) -> list[tuple[int, int]]:
    """Return start and end (exclusive) of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return [(int(first), int(end)) for first, end in edges.reshape(-1, 2)]


def format_frame_ranges(frame_index: Int[np.ndarray, "n"], rows: Bool[np.ndarray, "n"]) -> str:
    """Format the marked frames; frames that are neighbours among the n frames are joined: "3, 81-96"."""
    spans = [(int(frame_index[start]), int(frame_index[end - 1])) for start, end in runs_of(rows)]
    return ", ".join(str(first) if first == last else f"{first}-{last}" for first, last in spans)


def _evenly_spaced_indices(cumulative_motion: Float[np.ndarray, "m"], quota: int) -> Int[np.ndarray, "k"]:
    """Return `quota` positions in a non-decreasing sequence at which its values are as evenly spaced as possible."""
    if len(cumulative_motion) <= quota:
        return np.arange(len(cumulative_motion))
    if quota == 1:
        return np.array([len(cumulative_motion) // 2])
    chosen: list[int] = []
    for k, target in enumerate(np.linspace(cumulative_motion[0], cumulative_motion[-1], quota)):
        first = chosen[-1] + 1 if chosen else 0
        last = len(cumulative_motion) - quota + k
        chosen.append(first + int(np.argmin(np.abs(cumulative_motion[first : last + 1] - target))))
    chosen[-1] = len(cumulative_motion) - 1
    return np.array(chosen)
