"""What goes into a fit (observations from a detector's arrays), and what to think of the frames that come out of it."""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from pipeline.body.fit.energy import Observations
from pipeline.body.fit.fit import FitResult
from pipeline.body.fit.hand_observations import hand_landmarks
from pipeline.capture.frame_selection import frame_ranges
from pipeline.capture.hand_detector import Hands, no_hands
from pipeline.geometry.camera import Camera

LEAST_CONFIDENCE = 0.1
"""Trust in a landmark that the detector calls invisible: it still guesses better than a prior."""

LOW_OVERLAP = 0.10
"""A frame is doubtful when its overlap lies this far below the median."""

UNSURE_FOCAL = 0.15
"""A focal length is worth a word when it is known no better than this share of it."""

HIGH_ERROR = 3.0
"""A frame is doubtful when its landmark error is this many times the median."""

WRECKED_OVERLAP = 0.20
"""A frame is unusable when its overlap lies this far below the median: about what a leg beside its mask costs.

Worst behind the median in finished runs: turns 0.03, a self-capture 0.11, skirts 0.08; a ball in the mask 0.20.
"""

WRECKED_ERROR = 0.08
"""A frame is unusable when half of its landmarks lie this far from the body's, as a share of the person's height.

Most in finished runs: turns 0.013, a self-capture 0.047.
"""

ROUGH_OVERLAP = 0.85
"""A fit is worth a word whose median overlap is lower. In finished runs: turns 0.93, a skirt 0.87."""

VERDICTS = ("", "mended", "doubtful", "unusable")
"""What may be said of a frame, from well to worst."""


def make_observations(
    time_s: Float[np.ndarray, "n"],
    landmarks_px: Float[np.ndarray, "n 33 2"],
    visibility: Float[np.ndarray, "n 33"],
    landmarks_world_m: Float[np.ndarray, "n 33 3"],
    camera: Camera,
    hands: Hands | None = None,
) -> Observations:
    """Observations from a detector's output: nan where nothing was found, 3D in camera axes (y down, z away).

    hands: from `fit_hands.trusted_hands`; None where they were not looked for.
    """
    hands_px, hands_m, hands_trust = hand_landmarks(hands or no_hands(len(time_s)), landmarks_world_m)
    landmarks = torch.tensor(np.concatenate([landmarks_px, hands_px], axis=1)).double()
    directions = torch.tensor(np.concatenate([landmarks_world_m, hands_m], axis=1)).double()
    to_world = torch.as_tensor(camera.world_to_camera, dtype=torch.float64)[:3, :3]
    seen = LEAST_CONFIDENCE + (1.0 - LEAST_CONFIDENCE) * np.nan_to_num(visibility)
    trust = torch.tensor(np.concatenate([seen, hands_trust], axis=1)).double()
    known = landmarks.isfinite().all(-1)
    return Observations(
        time_s=torch.tensor(time_s).double(),
        landmarks_px=landmarks.nan_to_num(0.0),
        directions_m=directions.nan_to_num(0.0) @ to_world,
        confidence=trust * known,
        direction_confidence=trust * directions.isfinite().all(-1),
        camera=camera,
    )


def suspicious_frames(result: FitResult) -> Bool[np.ndarray, "n"]:
    """Frames whose overlap or landmark error falls far behind the rest, and frames without landmarks."""
    near = result.overlap >= median_overlap(result) - LOW_OVERLAP
    error = result.landmark_error_px
    return ~near | np.isnan(error) | (np.nan_to_num(error) > HIGH_ERROR * known_median(error))


def usable_frames(result: FitResult) -> Bool[np.ndarray, "n"]:
    """Frames that can be learnt from: False only where the body clearly is not where the person is.

    That is a frame without a mask, or whose overlap or landmarks miss by `WRECKED_OVERLAP` or `WRECKED_ERROR`. One
    without landmarks is judged by its overlap.
    """
    near = result.overlap >= median_overlap(result) - WRECKED_OVERLAP
    to_camera = result.camera.world_to_camera
    depth_m = result.root_translation_m @ to_camera[2, :3] + to_camera[2, 3]
    person_px = result.camera.fy * result.body.height_m() / depth_m
    return near & (np.nan_to_num(result.landmark_error_px) <= WRECKED_ERROR * person_px)


def median_overlap(result: FitResult) -> float:
    """Median over frames of the overlap with the masks, 0 to 1; a frame without a mask counts as 0."""
    return float(np.median(np.nan_to_num(result.overlap)))


def known_median(values: Float[np.ndarray, "n"]) -> float:
    """Median of the finite values; nan without any."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float("nan")


def verdicts(result: FitResult, doubtful: Bool[np.ndarray, "n"]) -> Int[np.ndarray, "n"]:
    """Position in `VERDICTS` of the worst that holds of each frame, given which are doubtful."""
    mended = np.stack(list(result.exchanged.values())).any(axis=0)
    return np.select([~usable_frames(result), doubtful, mended], [3, 2, 1], 0)


def frames_to_show(verdict: Int[np.ndarray, "n"], overlap: Float[np.ndarray, "n"], count: int) -> Int[np.ndarray, "k"]:
    """Positions, rising, of at most `count` frames: up to half of them those with the worst verdicts (and there the
    lowest overlap), the others evenly spread over the rest.
    """
    worst = np.lexsort((np.nan_to_num(overlap), -verdict))[: min(count // 2, np.count_nonzero(verdict))]
    others = np.setdiff1d(np.arange(len(verdict)), worst)
    even = np.linspace(0, len(others) - 1, min(count - len(worst), len(others))).astype(np.int64)
    return np.sort(np.concatenate([worst, others[even]]))


def doubts(result: FitResult, frame_index: Int[np.ndarray, "n"], training: Bool[np.ndarray, "n"]) -> list[str]:
    """Sentences about what a person should look at, for example "frames 81-96: ...". Empty when all is well.

    training: frames that later stages learn from, unless they are unusable.
    """
    sentences = []
    overlap = median_overlap(result)
    if overlap < ROUGH_OVERLAP:
        sentences.append(
            f"the body fits the masks only roughly (median overlap {overlap:.2f}): wide clothes, or wrong masks or "
            "camera; see overlay.png, and supply masks/, camera.json or body.height_m"
        )
    usable = usable_frames(result)
    if not usable.all():
        dropped = np.count_nonzero(training & ~usable)
        sentences.append(
            f"frames {frame_ranges(frame_index, ~usable)}: the body is not where the person is; {dropped} "
            f"frame{'' if dropped == 1 else 's'} dropped from the training; see overlay.png, and supply masks/ or "
            "landmarks.npz that are right there, or film it again"
        )
    for what, rows in result.exchanged.items():
        if rows.any():
            limbs = "left and right" if what == "whole body" else f"left and right {what}"
            sentences.append(
                f"frames {frame_ranges(frame_index, rows)}: the detector took {limbs} for each other; mended"
            )
    missing = np.isnan(result.landmark_error_px)
    if missing.any():
        sentences.append(
            f"frames {frame_ranges(frame_index, missing)}: no landmarks; the pose, unless it was supplied, follows the "
            "mask and time"
        )
    poor = suspicious_frames(result) & ~missing & usable
    if poor.any():
        sentences.append(
            f"frames {frame_ranges(frame_index, poor)}: the body fits worse than elsewhere; see overlay.png"
        )
    if result.focal_deviation > UNSURE_FOCAL:
        sentences.append(
            f"focal length {result.camera.fx:.0f} px is known to {100 * result.focal_deviation:.0f} % only: supply "
            "camera.json or body.field_of_view_deg, or film a full turn from nearer"
        )
    return sentences
