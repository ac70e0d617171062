"""Observations from detector output, and quality of the fitted frames."""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from pipeline.body.fit.detections.face_observations import face_landmarks
from pipeline.body.fit.detections.hand_observations import hand_landmarks
from pipeline.body.fit.detections.hidden_legs import leg_visibility_factor
from pipeline.body.fit.result import FitResult
from pipeline.body.fit.state import Observations
from pipeline.capture.face_detector import undetected_face
from pipeline.capture.frame_selection import format_frame_ranges
from pipeline.capture.hand_detector import HandLandmarks, undetected_hands
from pipeline.geometry.camera import Camera

MIN_CONFIDENCE = 0.1
"""Confidence of a landmark with visibility 0: the detector's guess is still better than the prior."""

SUSPICIOUS_IOU_DROP = 0.10
"""A frame is suspicious if its silhouette IoU is this far below the median."""

UNCERTAIN_FOCAL_STD = 0.15
"""Relative standard deviation of the focal length above which it is reported."""

SUSPICIOUS_ERROR_RATIO = 3.0
"""A frame is suspicious if its landmark error exceeds this multiple of the median."""

UNUSABLE_IOU_DROP = 0.20
"""A frame is unusable if its silhouette IoU is this far below the median: about one leg outside the mask.

Largest drops in finished runs: turns 0.03, a self-capture 0.11, skirts 0.08; a ball in the mask 0.20.
"""

UNUSABLE_ERROR_RATIO = 0.08
"""A frame is unusable if its median landmark error exceeds this fraction of the height of the person.

Maxima in finished runs: turns 0.013, a self-capture 0.047.
"""

ROUGH_FIT_IOU = 0.85
"""Median silhouette IoU below which the fit is reported. In finished runs: turns 0.93, a skirt 0.87."""

FRAME_RATINGS = ("", "corrected", "suspicious", "unusable")
"""Ratings of a frame, from good to worst."""


def make_observations(
    time_s: Float[np.ndarray, "n"],
    landmarks_px: Float[np.ndarray, "n 33 2"],
    visibility: Float[np.ndarray, "n 33"],
    landmarks_world_m: Float[np.ndarray, "n 33 3"],
    camera: Camera,
    hands: HandLandmarks | None = None,
    faces_px: Float[np.ndarray, "n 478 3"] | None = None,
) -> Observations:
    """Return the observations of a detector's output.

    landmarks_px, visibility (0 to 1): nan where nothing was detected. landmarks_world_m: camera axes (y down, z away),
    relative to the hips. hands: from `hand_observations.filter_hand_detections`; None if they were not detected.
    faces_px: as in `Capture`.
    """
    hands_px, hands_m, hands_confidence = hand_landmarks(hands or undetected_hands(len(time_s)), landmarks_world_m)
    known_faces_px = undetected_face(len(time_s)) if faces_px is None else faces_px
    face_px, face_confidence = face_landmarks(known_faces_px, landmarks_px, landmarks_world_m)
    landmarks = torch.tensor(np.concatenate([landmarks_px, hands_px, face_px], axis=1)).double()
    no_depth = np.full((*face_px.shape[:2], 3), np.nan)
    directions = torch.tensor(np.concatenate([landmarks_world_m, hands_m, no_depth], axis=1)).double()
    to_world = torch.as_tensor(camera.world_to_camera, dtype=torch.float64)[:3, :3]
    pose_confidence = MIN_CONFIDENCE + (1.0 - MIN_CONFIDENCE) * np.nan_to_num(visibility)
    pose_confidence *= leg_visibility_factor(visibility, time_s)
    landmark_confidence = torch.tensor(
        np.concatenate([pose_confidence, hands_confidence, face_confidence], axis=1)
    ).double()
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
    """Return the frames with a much lower IoU or larger landmark error than the others, and those without landmarks."""
    high_iou = result.silhouette_iou >= median_silhouette_iou(result) - SUSPICIOUS_IOU_DROP
    error = result.landmark_error_px
    return ~high_iou | np.isnan(error) | (np.nan_to_num(error) > SUSPICIOUS_ERROR_RATIO * finite_median(error))


def usable_frames(result: FitResult) -> Bool[np.ndarray, "n"]:
    """Return the frames that the training may use.

    Unusable: frames without a mask, with a low IoU (`UNUSABLE_IOU_DROP`) or large landmark errors
    (`UNUSABLE_ERROR_RATIO`). Frames without landmarks are rated by their IoU.
    """
    high_iou = result.silhouette_iou >= median_silhouette_iou(result) - UNUSABLE_IOU_DROP
    to_camera = result.camera.world_to_camera
    depth_m = result.root_translation_m @ to_camera[2, :3] + to_camera[2, 3]
    person_px = result.camera.fy * result.body.height_m() / depth_m
    return high_iou & (np.nan_to_num(result.landmark_error_px) <= UNUSABLE_ERROR_RATIO * person_px)


def median_silhouette_iou(result: FitResult) -> float:
    """Return the median over frames of the IoU with the masks, 0 to 1; a frame without a mask counts as 0."""
    return float(np.median(np.nan_to_num(result.silhouette_iou)))


def finite_median(values: Float[np.ndarray, "n"]) -> float:
    """Return the median of the finite values; nan if there are none."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float("nan")


def rate_frames(result: FitResult, suspicious: Bool[np.ndarray, "n"]) -> Int[np.ndarray, "n"]:
    """Return the index in `FRAME_RATINGS` of the worst rating that applies to each frame."""
    corrected = np.stack(list(result.left_right_swapped.values())).any(axis=0)
    return np.select([~usable_frames(result), suspicious, corrected], [3, 2, 1], 0)


def select_overlay_frames(
    rating: Int[np.ndarray, "n"], silhouette_iou: Float[np.ndarray, "n"], count: int
) -> Int[np.ndarray, "k"]:
    """Return ascending positions of at most `count` frames: up to half the worst rated, the others evenly spaced.

    Of equal ratings the lowest IoU comes first.
    """
    worst = np.lexsort((np.nan_to_num(silhouette_iou), -rating))[: min(count // 2, np.count_nonzero(rating))]
    others = np.setdiff1d(np.arange(len(rating)), worst)
    even = np.linspace(0, len(others) - 1, min(count - len(worst), len(others))).astype(np.int64)
    return np.sort(np.concatenate([worst, others[even]]))


def fit_warnings(result: FitResult, frame_index: Int[np.ndarray, "n"], training: Bool[np.ndarray, "n"]) -> list[str]:
    """Return warnings about the fit, for example "frames 81-96: ..."; empty for a good fit.

    training: frames that later stages train on, unless they are unusable.
    """
    warnings = []
    silhouette_iou = median_silhouette_iou(result)
    if silhouette_iou < ROUGH_FIT_IOU:
        warnings.append(
            f"the body fits the masks only roughly (median silhouette IoU {silhouette_iou:.2f}): wide clothes, wrong "
            "masks or a wrong camera; see overlay.png, and supply masks/, camera.json or body.height_m"
        )
    usable = usable_frames(result)
    if not usable.all():
        dropped = np.count_nonzero(training & ~usable)
        warnings.append(
            f"frames {format_frame_ranges(frame_index, ~usable)}: the body does not match the person; {dropped} "
            f"frame{'' if dropped == 1 else 's'} dropped from the training; see overlay.png, and supply correct masks/ "
            "or landmarks.npz for them, or record them again"
        )
    for body_part, rows in result.left_right_swapped.items():
        if rows.any():
            sides = "left and right" if body_part == "whole body" else f"left and right {body_part}"
            warnings.append(f"frames {format_frame_ranges(frame_index, rows)}: the detector swapped {sides}; corrected")
    missing = np.isnan(result.landmark_error_px)
    if missing.any():
        warnings.append(
            f"frames {format_frame_ranges(frame_index, missing)}: no landmarks; poses that were not supplied are "
            "fitted to the masks and the neighbouring frames"
        )
    suspicious_rows = suspicious_frames(result) & ~missing & usable
    if suspicious_rows.any():
        warnings.append(
            f"frames {format_frame_ranges(frame_index, suspicious_rows)}: the body fits worse than in other frames; "
            "see overlay.png"
        )
    if result.contradicting_focal_log:
        seen_px = result.camera.fx * float(np.exp(result.contradicting_focal_log))
        warnings.append(
            f"the supplied focal length of {result.camera.fx:.0f} px contradicts the turn, which shows about "
            f"{seen_px:.0f} px: correct or remove camera.json or body.field_of_view_deg"
        )
    if result.focal_relative_std > UNCERTAIN_FOCAL_STD:
        warnings.append(
            f"focal length {result.camera.fx:.0f} px has a standard deviation of "
            f"{100 * result.focal_relative_std:.0f} %: supply camera.json or body.field_of_view_deg, or film a full "
            "turn from a shorter distance"
        )
    return warnings
