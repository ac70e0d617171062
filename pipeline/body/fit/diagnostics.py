"""What goes into a fit (observations from a detector's arrays), and what to think of the frames that come out of it."""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from pipeline.body.fit.energy import Observations
from pipeline.body.fit.fit import FitResult
from pipeline.body.fit.hand_observations import hand_landmarks
from pipeline.capture.frame_selection import format_frame_ranges
from pipeline.capture.hand_detector import HandLandmarks, undetected_hands
from pipeline.geometry.camera import Camera

MIN_CONFIDENCE = 0.1
"""Trust in a landmark that the detector calls invisible: it still guesses better than a prior."""

SUSPICIOUS_IOU_DROP = 0.10
"""A frame is doubtful when its overlap lies this far below the median."""

UNCERTAIN_FOCAL_STD = 0.15
"""A focal length is worth a word when it is known no better than this share of it."""

SUSPICIOUS_ERROR_RATIO = 3.0
"""A frame is doubtful when its landmark error is this many times the median."""

UNUSABLE_IOU_DROP = 0.20
"""A frame is unusable when its overlap lies this far below the median: about what a leg beside its mask costs.

Worst behind the median in finished runs: turns 0.03, a self-capture 0.11, skirts 0.08; a ball in the mask 0.20.
"""

UNUSABLE_ERROR_RATIO = 0.08
"""A frame is unusable when half of its landmarks lie this far from the body's, as a share of the person's height.

Most in finished runs: turns 0.013, a self-capture 0.047.
"""

ROUGH_FIT_IOU = 0.85
"""A fit is worth a word whose median overlap is lower. In finished runs: turns 0.93, a skirt 0.87."""

FRAME_RATINGS = ("", "corrected", "suspicious", "unusable")
"""What may be said of a frame, from well to worst."""


def make_observations(
    time_s: Float[np.ndarray, "n"],
    landmarks_px: Float[np.ndarray, "n 33 2"],
    visibility: Float[np.ndarray, "n 33"],
    landmarks_world_m: Float[np.ndarray, "n 33 3"],
    camera: Camera,
    hands: HandLandmarks | None = None,
) -> Observations:
    """Observations from a detector's output: nan where nothing was found, 3D in camera axes (y down, z away).

    hands: from `fit_hands.filter_hand_detections`; None where they were not looked for.
    """
    hands_px, hands_m, hands_confidence = hand_landmarks(hands or undetected_hands(len(time_s)), landmarks_world_m)
    landmarks = torch.tensor(np.concatenate([landmarks_px, hands_px], axis=1)).double()
    directions = torch.tensor(np.concatenate([landmarks_world_m, hands_m], axis=1)).double()
    to_world = torch.as_tensor(camera.world_to_camera, dtype=torch.float64)[:3, :3]
    pose_confidence = MIN_CONFIDENCE + (1.0 - MIN_CONFIDENCE) * np.nan_to_num(visibility)
    landmark_confidence = torch.tensor(np.concatenate([pose_confidence, hands_confidence], axis=1)).double()
    known = landmarks.isfinite().all(-1)
    return Observations(
        time_s=torch.tensor(time_s).double(),
        landmarks_px=landmarks.nan_to_num(0.0),
        landmarks_3d_m=directions.nan_to_num(0.0) @ to_world,
        confidence=landmark_confidence * known,
        confidence_3d=landmark_confidence * directions.isfinite().all(-1),
        camera=camera,
    )


def suspicious_frames(result: FitResult) -> Bool[np.ndarray, "n"]:
    """Frames whose overlap or landmark error falls far behind the rest, and frames without landmarks."""
    near = result.silhouette_iou >= median_silhouette_iou(result) - SUSPICIOUS_IOU_DROP
    error = result.landmark_error_px
    return ~near | np.isnan(error) | (np.nan_to_num(error) > SUSPICIOUS_ERROR_RATIO * finite_median(error))


def usable_frames(result: FitResult) -> Bool[np.ndarray, "n"]:
    """Frames that can be learnt from: False only where the body clearly is not where the person is.

    That is a frame without a mask, or whose overlap or landmarks miss by `UNUSABLE_IOU_DROP` or
    `UNUSABLE_ERROR_RATIO`. One
    without landmarks is judged by its overlap.
    """
    near = result.silhouette_iou >= median_silhouette_iou(result) - UNUSABLE_IOU_DROP
    to_camera = result.camera.world_to_camera
    depth_m = result.root_translation_m @ to_camera[2, :3] + to_camera[2, 3]
    person_px = result.camera.fy * result.body.height_m() / depth_m
    return near & (np.nan_to_num(result.landmark_error_px) <= UNUSABLE_ERROR_RATIO * person_px)


def median_silhouette_iou(result: FitResult) -> float:
    """Median over frames of the overlap with the masks, 0 to 1; a frame without a mask counts as 0."""
    return float(np.median(np.nan_to_num(result.silhouette_iou)))


def finite_median(values: Float[np.ndarray, "n"]) -> float:
    """Median of the finite values; nan without any."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float("nan")


def rate_frames(result: FitResult, suspicious: Bool[np.ndarray, "n"]) -> Int[np.ndarray, "n"]:
    """Position in `FRAME_RATINGS` of the worst that holds of each frame, given which are doubtful."""
    corrected = np.stack(list(result.left_right_swapped.values())).any(axis=0)
    return np.select([~usable_frames(result), suspicious, corrected], [3, 2, 1], 0)


def select_overlay_frames(
    rating: Int[np.ndarray, "n"], silhouette_iou: Float[np.ndarray, "n"], count: int
) -> Int[np.ndarray, "k"]:
    """Positions, rising, of at most `count` frames: up to half of them those with the worst verdicts (and there the
    lowest overlap), the others evenly spread over the rest.
    """
    worst = np.lexsort((np.nan_to_num(silhouette_iou), -rating))[: min(count // 2, np.count_nonzero(rating))]
    others = np.setdiff1d(np.arange(len(rating)), worst)
    even = np.linspace(0, len(others) - 1, min(count - len(worst), len(others))).astype(np.int64)
    return np.sort(np.concatenate([worst, others[even]]))


def fit_warnings(result: FitResult, frame_index: Int[np.ndarray, "n"], training: Bool[np.ndarray, "n"]) -> list[str]:
    """Sentences about what a person should look at, for example "frames 81-96: ...". Empty when all is well.

    training: frames that later stages learn from, unless they are unusable.
    """
    warnings = []
    silhouette_iou = median_silhouette_iou(result)
    if silhouette_iou < ROUGH_FIT_IOU:
        warnings.append(
            f"the body fits the masks only roughly (median overlap {silhouette_iou:.2f}): wide clothes, or wrong "
            "masks or "
            "camera; see overlay.png, and supply masks/, camera.json or body.height_m"
        )
    usable = usable_frames(result)
    if not usable.all():
        dropped = np.count_nonzero(training & ~usable)
        warnings.append(
            f"frames {format_frame_ranges(frame_index, ~usable)}: the body is not where the person is; {dropped} "
            f"frame{'' if dropped == 1 else 's'} dropped from the training; see overlay.png, and supply masks/ or "
            "landmarks.npz that are right there, or film it again"
        )
    for body_part, rows in result.left_right_swapped.items():
        if rows.any():
            limbs = "left and right" if body_part == "whole body" else f"left and right {body_part}"
            warnings.append(
                f"frames {format_frame_ranges(frame_index, rows)}: the detector took {limbs} for each other; mended"
            )
    missing = np.isnan(result.landmark_error_px)
    if missing.any():
        warnings.append(
            f"frames {format_frame_ranges(frame_index, missing)}: no landmarks; the pose, unless it was supplied, "
            "follows the "
            "mask and time"
        )
    suspicious_rows = suspicious_frames(result) & ~missing & usable
    if suspicious_rows.any():
        warnings.append(
            f"frames {format_frame_ranges(frame_index, suspicious_rows)}: the body fits worse than elsewhere; see "
            "overlay.png"
        )
    if result.focal_relative_std > UNCERTAIN_FOCAL_STD:
        warnings.append(
            f"focal length {result.camera.fx:.0f} px is known to {100 * result.focal_relative_std:.0f} % only: supply "
            "camera.json or body.field_of_view_deg, or film a full turn from nearer"
        )
    return warnings
