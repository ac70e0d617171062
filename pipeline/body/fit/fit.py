"""Fit the parametric body to a recording: one shape, a pose a frame, the focal length where it is unknown.

Shape, focal length and landmark offsets are found on some frames spread over the recording, first from landmarks, then
from outlines as well; then every frame gets its pose with those held fixed. `fit_given` keeps shape and poses that
others fitted, or starts from them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pipeline.body.body import Body, ParametricBody
from pipeline.body.fit.camera_parameters import apply_intrinsics_delta, project_with_jacobian
from pipeline.body.fit.energy import EnergyParameters, FitState, Objective, Observations, compute_px_per_m
from pipeline.body.fit.ground_contact import Contact, estimate_floor_contact
from pipeline.body.fit.initialisation import has_torso_landmarks, initial_state, interpolated_state
from pipeline.body.fit.landmark_regressor import POSE_LANDMARK_COUNT, LandmarkRegressor, landmark_regressor
from pipeline.body.fit.left_right_swaps import (
    LIMB_SWAP_PAIRS,
    detect_body_swaps,
    detect_limb_swaps,
    swap_body_left_right,
    swap_limb_left_right,
)
from pipeline.body.fit.levenberg_marquardt import NormalEquations, minimise, shared_covariance
from pipeline.body.fit.linear_body import LinearBody, linearise_body, pose_points, pose_skeleton, relaxed_curls_rad
from pipeline.body.fit.priors import (
    PosePrior,
    ShapePrior,
    adapt_pose_prior,
    estimate_motion_std,
    pose_prior,
    shape_prior,
)
from pipeline.body.fit.root_placement import world_to_perspective
from pipeline.body.fit.silhouette_icp import MaskWindow, match_silhouettes
from pipeline.body.fit.supplied_poses import SuppliedPoses
from pipeline.core.progress import track
from pipeline.geometry.camera import Camera
from pipeline.geometry.rotation import continuous_quaternions, matrix_to_quaternion

MIN_FRAMES = 3
LANDMARK_STEPS = 12
SILHOUETTE_STEPS = 3
POSE_ROUNDS = 3
STATURE_STD_M = 0.09
"""Spread of adults' stature, which is how well an assumed one is known."""
SILHOUETTE_LANDMARK_STD_M = 0.06
SILHOUETTE_LANDMARK_3D_STD_M = 0.4
"""Standard deviations of a landmark in the image and in 3D once outlines help, which err less and in no fixed way."""


class TooFewLandmarksError(ValueError):
    """The frames do not say enough of the person's place to begin a fit."""


RELIABLE_CONFIDENCE = 0.5
"""Trust from which a landmark's distance tells how good a fit is."""

HAND_STD_M = 0.012
"""Standard deviation of a hand's points once the shape is known; before, the body's own errors are larger."""


@dataclass(frozen=True)
class FitOptions:
    """`height_m` and deviations of 0 take unknowns away; `shared_frames` and `rounds` are the effort.

    focal_deviation: standard deviation of the logarithm of the true focal length over the one to start from.
    centre_deviation: standard deviation of the principal point about the one to start from, in focal lengths.
    """

    height_m: float | None = None
    focal_relative_std: float = 0.5
    principal_point_relative_std: float = 0.0
    shared_frames: int = 48
    rounds: int = 8


@dataclass(frozen=True)
class FitResult:
    """The fitted person, n frames. Deviations are one standard deviation, from the fit's own curvature."""

    body: Body
    rotations_wxyz: Float[np.ndarray, "n full 4"]
    root_translation_m: Float[np.ndarray, "n 3"]
    camera: Camera
    landmark_error_px: Float[np.ndarray, "n"]
    silhouette_iou: Float[np.ndarray, "n"]
    left_right_swapped: dict[str, Bool[np.ndarray, "n"]]
    focal_relative_std: float
    height_std_m: float


@dataclass(frozen=True)
class _FitContext:
    """What does not change during a fit."""

    body: ParametricBody
    regressor: LandmarkRegressor
    pose_prior: PosePrior
    shape_prior: ShapePrior
    default: LinearBody
    curls_rad: Float[np.ndarray, "2 4"]

    def model(self, shape: Float[Tensor, "s"]) -> LinearBody:
        """The body around a shape."""
        return linearise_body(self.body, shape, self.curls_rad)


def fit_body(
    body: ParametricBody,
    observations: Observations,
    windows: Sequence[MaskWindow | None],
    options: FitOptions,
    curls_rad: Float[np.ndarray, "2 4"] | None = None,
) -> FitResult:
    """Fit a body to landmarks and masks.

    observations.camera holds the focal length to start from. Windows come from `fit_silhouette.crop_mask_window`,
    curls_rad from `fit_hands.finger_curls_rad` (None: a relaxed grip).
    Raises ValueError when fewer than three frames have a torso in pixels and in 3D.
    """
    _check_landmarks(observations)
    context = _build_context(body, relaxed_curls_rad() if curls_rad is None else curls_rad)
    rest_landmarks_m = context.regressor.points(
        context.default, torch.zeros(_offset_count(context), dtype=torch.float64)
    ).rest[0]
    observations, left_right_swapped = _correct_left_right_swaps(observations, rest_landmarks_m)
    start = initial_state(
        observations, rest_landmarks_m, context.default.joints, body.shape_defaults.double(), _offset_count(context)
    )
    chosen = select_shared_frames(observations, windows, options.shared_frames)
    state, weights, system = _fit_shared(
        context, observations.rows(chosen), [windows[row] for row in chosen], start.rows(chosen), options
    )
    state = interpolated_state(state, chosen, observations.time_s)
    state, model, silhouette_iou = _fit_poses(context, observations, windows, state, weights)
    stature_std_m = STATURE_STD_M if options.height_m is None else 0.0
    return _result(context, model, state, system, observations, silhouette_iou, left_right_swapped, stature_std_m)


def fit_given(
    body: ParametricBody,
    observations: Observations,
    windows: Sequence[MaskWindow | None],
    supplied: SuppliedPoses,
    keep: bool,
) -> FitResult:
    """Take over shape and poses that others fitted; frames that they lack are fitted, from between their neighbours.

    observations.camera is the camera that the given poses belong to.
    keep: the given poses stay as they are; else every pose goes on from them to landmarks and outlines.
    Raises ValueError when no frame has a pose, or as `fit_body` does where a frame is fitted.
    """
    to_fit = np.ones(len(windows), dtype=bool)
    to_fit[supplied.rows] = not keep
    if to_fit.any():
        _check_landmarks(observations)
    context = _build_context(body, relaxed_curls_rad())
    model = context.model(supplied.shape)
    state = supplied.state(model.full_joint_indices, observations.time_s)
    rest_landmarks_m = context.regressor.points(model, state.landmark_offsets_m).rest[0]
    observations, left_right_swapped = _correct_left_right_swaps(observations, rest_landmarks_m)
    left_right_swapped = {sides: rows & to_fit for sides, rows in left_right_swapped.items()}
    if to_fit.any():
        weights = EnergyParameters(
            landmark_std_m=SILHOUETTE_LANDMARK_STD_M, landmark_3d_std_m=SILHOUETTE_LANDMARK_3D_STD_M
        )
        state, _, _ = _fit_poses(context, observations, windows, state, weights)
    if keep:
        state = supplied.overwrite_poses(state, model.full_joint_indices)
    _, silhouette_iou = match_silhouettes(model, state, observations, windows)
    result = _result(context, model, state, None, observations, silhouette_iou, left_right_swapped, 0.0)
    return replace(result, rotations_wxyz=supplied.overwrite_all_rotations(result.rotations_wxyz)) if keep else result


def select_shared_frames(
    observations: Observations, windows: Sequence[MaskWindow | None], count: int
) -> Int[np.ndarray, "k"]:
    """Frames for the shared unknowns: evenly spread over those with landmarks and mask (without masks: landmarks)."""
    found = has_torso_landmarks(observations)
    with_mask = found & np.array([window is not None for window in windows])
    candidates = np.flatnonzero(with_mask if with_mask.sum() >= MIN_FRAMES else found)
    return np.unique(candidates[np.linspace(0, len(candidates) - 1, min(count, len(candidates))).astype(np.int64)])


def _check_landmarks(observations: Observations) -> None:
    if has_torso_landmarks(observations).sum() < MIN_FRAMES:
        raise TooFewLandmarksError(f"fewer than {MIN_FRAMES} frames have hips and shoulders in pixels and in 3D")


def _build_context(body: ParametricBody, curls_rad: Float[np.ndarray, "2 4"]) -> _FitContext:
    default = linearise_body(body, body.shape_defaults, curls_rad)
    return _FitContext(
        body,
        landmark_regressor(default),
        pose_prior(default),
        shape_prior(body.shape_names, body.shape_defaults),
        default,
        curls_rad,
    )


def _offset_count(context: _FitContext) -> int:
    return context.regressor.offset_jacobian.shape[-1]


def _correct_left_right_swaps(
    observations: Observations, rest_landmarks_m: Float[Tensor, "l 3"]
) -> tuple[Observations, dict[str, Bool[np.ndarray, "n"]]]:
    """Observations with exchanged sides put right, and in which frames that happened."""
    left_right_swapped = {"whole body": detect_body_swaps(observations, rest_landmarks_m)}
    observations = swap_body_left_right(observations, left_right_swapped["whole body"])
    for limb in LIMB_SWAP_PAIRS:
        left_right_swapped[limb] = detect_limb_swaps(observations, limb)
        observations = swap_limb_left_right(observations, left_right_swapped[limb], limb)
    return observations, left_right_swapped


def _fit_shared(
    context: _FitContext,
    observations: Observations,
    windows: Sequence[MaskWindow | None],
    state: FitState,
    options: FitOptions,
) -> tuple[FitState, EnergyParameters, NormalEquations]:
    """Shape, focal length and landmark offsets (with the poses of these frames), and the last normal equations."""
    weights = (
        EnergyParameters()
        if options.height_m is None
        else EnergyParameters(height_m=options.height_m, height_std_m=0.005)
    )
    state, _ = _fit_landmarks(context, context.default, observations, weights, state, LANDMARK_STEPS)
    weights = replace(weights, free_landmark_offsets=True)
    if options.focal_relative_std > 0.0:
        weights = replace(weights, free_focal=True, log_focal_std=options.focal_relative_std)
    if options.principal_point_relative_std > 0.0:
        weights = replace(weights, free_principal_point=True, principal_point_std=options.principal_point_relative_std)
    model = context.model(state.shape)
    state, system = _fit_landmarks(context, model, observations, weights, state, LANDMARK_STEPS)
    weights = replace(weights, landmark_std_m=SILHOUETTE_LANDMARK_STD_M, landmark_3d_std_m=SILHOUETTE_LANDMARK_3D_STD_M)
    for _ in track(range(options.rounds), "shape and focal length"):
        model = context.model(state.shape)
        state, system, _ = _silhouette_round(context, model, observations, windows, weights, state)
    return state, weights, system


def _fit_poses(
    context: _FitContext,
    observations: Observations,
    windows: Sequence[MaskWindow | None],
    state: FitState,
    weights: EnergyParameters,
) -> tuple[FitState, LinearBody, Float[np.ndarray, "n"]]:
    """The pose of every frame with all that is shared held fixed, and each frame's overlap with its mask."""
    weights = replace(
        weights,
        free_shape=False,
        free_landmark_offsets=False,
        free_focal=False,
        free_principal_point=False,
        hand_std_m=HAND_STD_M,
    )
    model = context.model(state.shape)
    landmarks_only = replace(
        weights, landmark_std_m=EnergyParameters.landmark_std_m, landmark_3d_std_m=EnergyParameters.landmark_3d_std_m
    )
    state, _ = _fit_landmarks(context, model, observations, landmarks_only, state, SILHOUETTE_STEPS)
    motion = None
    for _ in track(range(POSE_ROUNDS), "poses"):
        contact = estimate_floor_contact(
            model, state.rotations, state.root_m, observations.confidence, observations.time_s
        )
        state, _, _ = _silhouette_round(context, model, observations, windows, weights, state, motion, contact)
        root_perspective = world_to_perspective(state.root_m, observations.camera)
        motion = estimate_motion_std(state.rotations, root_perspective, observations.time_s)
    _, silhouette_iou = match_silhouettes(model, state, observations, windows)
    return state, model, silhouette_iou


def _silhouette_round(
    context: _FitContext,
    model: LinearBody,
    observations: Observations,
    windows: Sequence[MaskWindow | None],
    weights: EnergyParameters,
    state: FitState,
    motion: Float[Tensor, "p"] | None = None,
    contact: Contact | None = None,
) -> tuple[FitState, NormalEquations, Float[np.ndarray, "n"]]:
    """Pair outlines for the body as it stands, then move it."""
    contour, silhouette_iou = match_silhouettes(model, state, observations, windows)
    objective = Objective(
        model,
        context.regressor,
        adapt_pose_prior(context.pose_prior, state.rotations),
        context.shape_prior,
        observations,
        weights,
        compute_px_per_m(state, observations.camera),
        contour,
        motion,
        contact,
    )
    state, system = minimise(state, objective, objective.retract, SILHOUETTE_STEPS)
    return state, system, silhouette_iou


def _fit_landmarks(
    context: _FitContext,
    model: LinearBody,
    observations: Observations,
    weights: EnergyParameters,
    state: FitState,
    steps: int,
) -> tuple[FitState, NormalEquations]:
    """Fit to landmarks alone."""
    objective = Objective(
        model,
        context.regressor,
        context.pose_prior,
        context.shape_prior,
        observations,
        weights,
        compute_px_per_m(state, observations.camera),
    )
    return minimise(state, objective, objective.retract, steps)


def landmark_errors_px(
    regressor: LandmarkRegressor, model: LinearBody, state: FitState, observations: Observations
) -> Float[np.ndarray, "n"]:
    """Median distance of each frame's well-seen pose landmarks from the body's, of all that are known where none is
    well seen; nan without any.
    """
    skeleton = pose_skeleton(model, state.rotations, state.root_m)
    world, _ = pose_points(model, skeleton, regressor.points(model, state.landmark_offsets_m))
    pixels, _ = project_with_jacobian(world, apply_intrinsics_delta(observations.camera, state.intrinsics_delta))
    error = (pixels - observations.landmarks_px).norm(dim=-1)[:, :POSE_LANDMARK_COUNT]
    landmark_confidence = observations.confidence[:, :POSE_LANDMARK_COUNT]
    reliable = landmark_confidence > RELIABLE_CONFIDENCE
    counted = torch.where(reliable.any(1, keepdim=True), reliable, landmark_confidence > 0.0)
    return torch.where(counted, error, torch.nan).nanmedian(1).values.numpy()


def _result(
    context: _FitContext,
    model: LinearBody,
    state: FitState,
    system: NormalEquations | None,
    observations: Observations,
    silhouette_iou: Float[np.ndarray, "n"],
    left_right_swapped: dict[str, Bool[np.ndarray, "n"]],
    stature_std_m: float,
) -> FitResult:
    focal_relative_std, height_std_m = (0.0, 0.0) if system is None else _posterior_stds(model, system)
    quaternions = matrix_to_quaternion(model.all_joint_rotations(state.rotations))
    return FitResult(
        body=context.body.body(state.shape.float()),
        rotations_wxyz=continuous_quaternions(quaternions).float().numpy(),
        root_translation_m=state.root_m.float().numpy(),
        camera=apply_intrinsics_delta(observations.camera, state.intrinsics_delta),
        landmark_error_px=landmark_errors_px(context.regressor, model, state, observations),
        silhouette_iou=silhouette_iou,
        left_right_swapped=left_right_swapped,
        focal_relative_std=focal_relative_std,
        height_std_m=float(np.hypot(height_std_m, stature_std_m)),
    )


def _posterior_stds(model: LinearBody, system: NormalEquations) -> tuple[float, float]:
    """Of the logarithm of the focal length, and of the stature (m)."""
    covariance, gradient = shared_covariance(system), model.height_m()[1].numpy()
    variance = gradient @ covariance[: len(gradient), : len(gradient)] @ gradient
    focal = float(np.sqrt(covariance[-1, -1])) if system.border[..., -1].any() else 0.0
    return focal, float(np.sqrt(variance))
