"""Result of a fit, and its reprojection errors."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float

from pipeline.body.body import Body
from pipeline.body.fit.camera_parameters import apply_intrinsics_delta, project_with_jacobian
from pipeline.body.fit.landmark_regressor import POSE_LANDMARK_COUNT, LandmarkRegressor
from pipeline.body.fit.levenberg_marquardt import NormalEquations, shared_covariance
from pipeline.body.fit.linear_body import LinearBody
from pipeline.body.fit.posed_points import pose_points, pose_skeleton
from pipeline.body.fit.state import FitState, Observations
from pipeline.geometry.camera import Camera

RELIABLE_CONFIDENCE = 0.5
"""Minimum confidence of a landmark that counts in the landmark error of a frame."""


@dataclass(frozen=True)
class FitResult:
    """The fitted person and camera, n frames.

    body, bare: the person in clothes, as the body that fills them, and without; the same if no clothes were fitted.
    landmark_error_px, silhouette_iou: of each frame; nan without landmarks or mask. The silhouette is that of the
        clothed body.
    left_right_swapped: by body part, the frames whose landmarks were swapped.
    focal_relative_std, height_std_m: standard deviations from the curvature of the energy.
    contradicting_focal_log: logarithm of the focal length that a turn shows over the supplied one, if they contradict;
        0 if they do not, or none was supplied.
    lean_deg: angle between +Y and the mean axis of the trunk (mid-hips to neck); over a full turn 0 for upright people.
    shape_is_supplied: the user knows the shape, and it was not fitted.
    """

    body: Body
    bare: Body
    rotations_wxyz: Float[np.ndarray, "n full 4"]
    root_translation_m: Float[np.ndarray, "n 3"]
    camera: Camera
    landmark_error_px: Float[np.ndarray, "n"]
    silhouette_iou: Float[np.ndarray, "n"]
    left_right_swapped: dict[str, Bool[np.ndarray, "n"]]
    focal_relative_std: float
    height_std_m: float
    lean_deg: float
    contradicting_focal_log: float = 0.0
    shape_is_supplied: bool = False


def landmark_errors_px(
    regressor: LandmarkRegressor, model: LinearBody, state: FitState, observations: Observations
) -> Float[np.ndarray, "n"]:
    """Return the median reprojection error of each frame's reliable pose landmarks (px).

    Frames without reliable landmarks use all that were detected; nan if there are none.
    """
    skeleton = pose_skeleton(model, state.rotations, state.root_m)
    points = pose_points(model, skeleton, regressor.points(model, state.landmark_offsets_m))
    camera = apply_intrinsics_delta(observations.camera, state.intrinsics_delta)
    pixels, _ = project_with_jacobian(points.world_m, camera)
    error = (pixels - observations.landmarks_px).norm(dim=-1)[:, :POSE_LANDMARK_COUNT]
    confidence = observations.confidence[:, :POSE_LANDMARK_COUNT]
    reliable = confidence > RELIABLE_CONFIDENCE
    counted = torch.where(reliable.any(1, keepdim=True), reliable, confidence > 0.0)
    return torch.where(counted, error, torch.nan).nanmedian(1).values.numpy()


def shared_step_ratio(before: FitState, after: FitState, system: NormalEquations) -> float:
    """Return the root mean square of a step of the shared parameters, in standard deviations of what is known."""
    step = (after.shared_parameters() - before.shared_parameters()).numpy()
    return float(np.sqrt(np.mean(step**2 / np.diag(shared_covariance(system)))))


def posterior_stds(model: LinearBody, system: NormalEquations) -> tuple[float, float]:
    """Return the standard deviations of the logarithm of the focal length and of the stature (m)."""
    covariance, gradient = shared_covariance(system), model.height_m()[1].numpy()
    variance = gradient @ covariance[: len(gradient), : len(gradient)] @ gradient
    focal = float(np.sqrt(covariance[-1, -1])) if system.border[..., -1].any() else 0.0
    return focal, float(np.sqrt(variance))
