"""A fit without the frames that show someone or something else, which a first fit finds.

A passer-by whom the detector takes for the person in a few frames changes more than these frames: size and place jump,
which only another focal length explains.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float

from pipeline.body.body import ParametricBody
from pipeline.body.fit.diagnostics import suspicious_frames, usable_frames
from pipeline.body.fit.fit import fit_body
from pipeline.body.fit.options import FitOptions
from pipeline.body.fit.result import FitResult
from pipeline.body.fit.silhouette_icp import MaskWindow
from pipeline.body.fit.state import Observations
from pipeline.core.progress import warn

MAX_REJECTED_SHARE = 0.3
"""Share of rejected frames above which it is unclear who the person is, and the first fit is kept."""
CHECKPOINTS = ("checkpoint_first_fit", "checkpoint_second_fit")


def fit_body_without_others(
    body: ParametricBody,
    observations: Observations,
    windows: Sequence[MaskWindow | None],
    options: FitOptions,
    curls_rad: Float[np.ndarray, "2 4"] | None = None,
    out: Path | None = None,
) -> FitResult:
    """Fit a body as `fit_body` does; if some frames do not match it, again without their landmarks and masks.

    Their poses are then those between the frames around them, and their silhouette IoU is 0: they are not trained on.

    out: folder of the checkpoints, one for each fit, with and without a hem; None: none.

    Raises:
        TooFewLandmarksError: as `fit_body`.
    """
    suffix = ".safetensors" if options.hem is None else "_with_hem.safetensors"
    checkpoints = [None if out is None else out / f"{name}{suffix}" for name in CHECKPOINTS]
    first = fit_body(body, observations, windows, options, curls_rad, checkpoints[0])
    rejected = frames_of_others(first)
    if not rejected.any() or rejected.mean() > MAX_REJECTED_SHARE:
        return first
    warn(f"{rejected.sum()} frames do not match the body; it is fitted again without them")
    kept = torch.from_numpy(~rejected)[:, None]
    observations = replace(
        observations, confidence=observations.confidence * kept, confidence_3d=observations.confidence_3d * kept
    )
    windows = [None if is_other else window for window, is_other in zip(windows, rejected, strict=True)]
    second = fit_body(body, observations, windows, options, curls_rad, checkpoints[1])
    return replace(
        second,
        silhouette_iou=np.where(rejected, 0.0, second.silhouette_iou),
        landmark_error_px=np.where(rejected, first.landmark_error_px, second.landmark_error_px),
    )


def frames_of_others(result: FitResult) -> Bool[np.ndarray, "n"]:
    """Return unusable frames with landmarks, and the suspicious ones beside them without a good one between."""
    unusable, suspicious = ~usable_frames(result) & np.isfinite(result.landmark_error_px), suspicious_frames(result)
    runs = np.cumsum(np.diff(unusable | suspicious, prepend=False))
    return (unusable | suspicious) & np.isin(runs, runs[unusable])
