"""The split that holds out the end of a recording, so that no learnt frame is close in time to a held-out one.

A person who turns several times is held out for the last turn; otherwise the last quarter of the recording is. The
number of turns follows from the yaw of the torso in the detector's 3D landmarks.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy.ndimage import median_filter

from pipeline.capture.frame_selection import HELDOUT, TRAIN, UNUSED, VALIDATION, VALIDATION_PHASE, split_phases

LAST_PART = 0.25
"""Fraction of the frames that is held out where there is no second turn."""

GUARD_PART = 0.04
"""Fraction of the frames, before the held-out ones, that is used for neither."""

_MIN_GUARD_FRAMES = 2
_TURN_TOLERANCE = 0.1
"""A turn may be shorter by this fraction, because a recording ends a little early."""

_YAW_MEDIAN_FRAMES = 7
"""Window of the median filter that removes frames in which the detector confuses front and back."""


@dataclass(frozen=True)
class DisjointSplit:
    """The split of frames in order of time.

    split: TRAIN, VALIDATION, HELDOUT, or UNUSED for the guard gap.
    turns: turns of the person in the whole recording, 0 and more.
    held_out_part: in words, for the protocol of the scores.
    """

    split: UInt8[np.ndarray, "n"]
    turns: float
    held_out_part: str


def assign_disjoint_splits(frame_index: Int[np.ndarray, "n"], yaw_rad: Float[np.ndarray, "n"]) -> DisjointSplit:
    """Hold out the last turn of at least two, else the last quarter of the frames.

    With k turns, the last k-th of the rotation is held out. Before it there is a guard gap. Among the other frames,
    those of phase 4 (`split_phases`) are validation frames.

    Args:
        frame_index: increasing.
        yaw_rad: of the torso, `pipeline.capture.frame_selection.body_yaw_rad`; nan where unknown.
    """
    count = len(frame_index)
    turned = cumulative_turns(yaw_rad)
    turns = float(turned[-1]) if count else 0.0
    whole_turns = int(turns + _TURN_TOLERANCE)
    if whole_turns >= 2:
        first = int(np.searchsorted(turned, turns * (whole_turns - 1) / whole_turns))
        part = f"the last of {whole_turns} turns"
    else:
        first = round((1.0 - LAST_PART) * count)
        part = "the last quarter"
    guard = max(_MIN_GUARD_FRAMES, round(GUARD_PART * count))
    split = np.where(split_phases(frame_index) == VALIDATION_PHASE, VALIDATION, TRAIN).astype(np.uint8)
    split[max(0, first - guard) : first] = UNUSED
    split[first:] = HELDOUT
    return DisjointSplit(split, turns, part)


def cumulative_turns(yaw_rad: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Return the number of turns up to each frame, non-decreasing from 0; turning back does not count.

    The direction is that of the whole recording. Frames without a yaw have the value of the frame before them.
    """
    known = np.flatnonzero(np.isfinite(yaw_rad))
    if len(known) < 2:
        return np.zeros(len(yaw_rad))
    filtered = [
        median_filter(wave(yaw_rad[known]), size=_YAW_MEDIAN_FRAMES, mode="nearest") for wave in (np.sin, np.cos)
    ]
    unwrapped = np.unwrap(np.arctan2(*filtered)) / (2.0 * np.pi)
    advance = (unwrapped - unwrapped[0]) * np.sign(unwrapped[-1] - unwrapped[0])
    turned = np.zeros(len(yaw_rad))
    turned[known] = advance
    return np.maximum.accumulate(turned)
