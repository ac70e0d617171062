"""What goes into a fit (observations from a detector's arrays), and words about the doubtful frames that come out."""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from pipeline.avatar.fit import FitResult
from pipeline.avatar.fit_hands import hand_landmarks
from pipeline.avatar.fit_objective import Observations
from pipeline.avatar.hands import Hands, no_hands
from pipeline.geometry.camera import Camera

LEAST_CONFIDENCE = 0.1
"""Trust in a landmark that the detector calls invisible: it still guesses better than a prior."""

LOW_OVERLAP = 0.10
"""A frame is doubtful when its overlap lies this far below the median."""

UNSURE_FOCAL = 0.15
"""A focal length is worth a word when it is known no better than this share of it."""

HIGH_ERROR = 3.0
"""A frame is doubtful when its landmark error is this many times the median."""


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
    low = result.overlap < np.nanmedian(result.overlap) - LOW_OVERLAP
    error = result.landmark_error_px
    return low | (error > HIGH_ERROR * np.nanmedian(error)) | np.isnan(error)


def doubts(result: FitResult, frame_index: Int[np.ndarray, "n"]) -> list[str]:
    """Sentences about frames that a person should look at, for example "frames 81-96: ...". Empty when all is well."""
    sentences = []
    for what, rows in result.exchanged.items():
        if rows.any():
            limbs = "left and right" if what == "whole body" else f"left and right {what}"
            sentences.append(
                f"frames {frame_ranges(frame_index, rows)}: the detector took {limbs} for each other; mended"
            )
    missing = np.isnan(result.landmark_error_px)
    if missing.any():
        sentences.append(
            f"frames {frame_ranges(frame_index, missing)}: no landmarks; the pose follows the mask and time"
        )
    poor = suspicious_frames(result) & ~missing
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


def frame_ranges(frame_index: Int[np.ndarray, "n"], rows: Bool[np.ndarray, "n"]) -> str:
    """Marked frames in words: neighbours among the chosen frames are joined, "3, 81-96"."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], rows.astype(np.int8), [0]])))
    spans = [(int(frame_index[start]), int(frame_index[end - 1])) for start, end in edges.reshape(-1, 2)]
    return ", ".join(str(first) if first == last else f"{first}-{last}" for first, last in spans)
