"""Fit of the parametric body to a recording: one shape, a pose in each frame, and the camera intrinsics if unknown.

The shared parameters (shape, focal length, principal point, landmark offsets) are fitted on some frames spread over the
recording, first to landmarks, then to silhouettes as well. Then the poses of all frames are fitted with the shared
parameters fixed. The shape includes clothes (`prior.clothing`), which masks show.
`fit_supplied_poses` keeps user-supplied shape and poses, or starts from them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pipeline.body.body import ParametricBody
from pipeline.body.fit.camera_parameters import apply_intrinsics_delta
from pipeline.body.fit.checkpoint import FitProgress, load_progress, save_progress
from pipeline.body.fit.context import FitContext
from pipeline.body.fit.detections.left_right_swaps import (
    LIMB_SWAP_PAIRS,
    detect_body_swaps,
    detect_limb_swaps,
    swap_body_left_right,
    swap_limb_left_right,
)
from pipeline.body.fit.energy import EnergyParameters, Objective, compute_px_per_m
from pipeline.body.fit.ground_contact import Contact, estimate_floor_contact
from pipeline.body.fit.initialisation import has_torso_landmarks, initial_state, interpolated_state
from pipeline.body.fit.levenberg_marquardt import NormalEquations, minimise
from pipeline.body.fit.linear_body import LinearBody, relaxed_curls_rad
from pipeline.body.fit.options import (
    FitOptions,
    free_parameters,
    landmark_parameters,
    shared_parameters,
    with_silhouettes,
)
from pipeline.body.fit.prior.forearm_flips import unflip_forearms
from pipeline.body.fit.prior.posture import Posture, prior_of_recording
from pipeline.body.fit.prior.priors import estimate_motion_std
from pipeline.body.fit.result import FitResult, landmark_errors_px, posterior_stds, shared_step_ratio
from pipeline.body.fit.root_placement import world_to_perspective
from pipeline.body.fit.silhouette_icp import MaskWindow, match_silhouettes
from pipeline.body.fit.state import FitState, Observations
from pipeline.body.fit.supplied_poses import SuppliedPoses
from pipeline.body.fit.vertical import gravity
from pipeline.body.fit.vertical.turn_axis import contradicting_focal_log, estimate_turn_axis
from pipeline.body.settings import DEFAULT_SETTINGS, FitSettings
from pipeline.capture.frame_selection import evenly_spaced
from pipeline.core.progress import track
from pipeline.geometry.rotation import continuous_quaternions, matrix_to_quaternion

MIN_FRAMES = 3
POSTURE_ROUND = 3
"""Number of matchings of the silhouettes before the posture of the recording is estimated."""

CONVERGED_STEP_RATIO = 0.1
"""Step of shape, camera and landmark offsets, in standard deviations, below which no further silhouettes are matched.

Matched silhouettes jitter by 0.06 to 0.1: more rounds do not end nearer to the truth (docs/decisions/body.md)."""

CONVERGED_TURN_RAD = np.radians(0.3)
"""Turn of the world after a round below which it counts as vertical."""


class TooFewLandmarksError(ValueError):
    """Too few frames have the landmarks that the initial state needs."""


@dataclass(frozen=True)
class _Recording:
    """What the poses so far tell of the recording: posture, `Objective.motion_std` and contacts with the floor."""

    posture: Posture | None
    motion_std: Float[Tensor, "p"] | None = None
    contact: Contact | None = None


def fit_body(
    body: ParametricBody,
    observations: Observations,
    windows: Sequence[MaskWindow | None],
    options: FitOptions,
    curls_rad: Float[np.ndarray, "2 4"] | None = None,
    checkpoint: Path | None = None,
) -> FitResult:
    """Fit a body to landmarks and masks.

    observations: their camera is the initial one, level unless the vertical is known.
    windows: from `silhouette_icp.crop_mask_window`.
    curls_rad: from `hand_observations.finger_curls_rad`; None: relaxed fingers.
    checkpoint: file from which an interrupted fit of the same inputs continues; None: it starts over.

    Raises:
        TooFewLandmarksError: fewer than three frames have a torso in pixels and in 3D.
    """
    _check_landmarks(observations)
    curls_rad = relaxed_curls_rad() if curls_rad is None else curls_rad
    context = replace(FitContext.of(body, curls_rad, options.settings, has_clothing=True), hem=options.hem)
    offset_count = context.regressor.offset_jacobian.shape[-1]
    no_offsets = torch.zeros(offset_count, dtype=torch.float64)
    rest_landmarks_m = context.regressor.points(context.default, no_offsets).rest_m[0]
    observations, left_right_swapped = _correct_left_right_swaps(observations, rest_landmarks_m)
    contradiction = contradicting_focal_log(observations) if options.focal_relative_std == 0.0 else 0.0
    evidence = None
    if not options.vertical_is_known:
        axis = estimate_turn_axis(observations, options.focal_relative_std)
        evidence = gravity.axis_evidence(axis, options.settings)
        observations = gravity.turn_observations(observations, evidence.up(), axis, rest_landmarks_m)
        if axis is not None and options.focal_relative_std > 0.0:
            # The deviation of the principal point is in focal lengths.
            shift_std = options.principal_point_relative_std * float(np.exp(-axis.focal_log))
            options = replace(options, principal_point_relative_std=shift_std)
            # The focal length of a turn's axis is a start and no evidence: the same landmarks tell it again in the fit.
            if axis.is_arc:
                options = replace(options, focal_relative_std=axis.focal_log_std)
    progress = load_progress(checkpoint)
    if progress is None:
        start = initial_state(
            observations, rest_landmarks_m, context.default.joints_m, context.default.shape, offset_count
        )
        progress = _fit_shared(context, observations, windows, start, options, evidence)
        save_progress(checkpoint, progress)
    observations = gravity.turn_world(observations, progress.to_vertical)
    parameters = shared_parameters(options)
    state, model, silhouette_iou = _fit_poses(context, observations, windows, progress, parameters, checkpoint)
    if evidence is not None:
        evidence = evidence.about(progress.to_vertical[:, 1])
        state, observations = gravity.align_with_gravity(model, state, observations, evidence, options.settings)
    stature_std_m = options.settings.stature_spread_m if options.height_m is None else 0.0
    return replace(
        _result(context, model, state, observations, silhouette_iou, left_right_swapped),
        focal_relative_std=progress.focal_relative_std,
        height_std_m=float(np.hypot(progress.height_std_m, stature_std_m)),
        contradicting_focal_log=contradiction,
    )


def fit_supplied_poses(
    body: ParametricBody,
    observations: Observations,
    windows: Sequence[MaskWindow | None],
    supplied: SuppliedPoses,
    keep: bool,
    settings: FitSettings = DEFAULT_SETTINGS,
) -> FitResult:
    """Use user-supplied shape and poses; interpolate and fit the poses of the other frames.

    observations: their camera is that of the supplied poses, whose world is kept.
    keep: whether the supplied poses stay unchanged; otherwise all poses are refined with landmarks and silhouettes.

    Raises:
        TooFewLandmarksError: as `fit_body`, if any frame is fitted.
        ValueError: there are no supplied poses.
    """
    to_fit = np.ones(len(windows), dtype=bool)
    to_fit[supplied.rows] = not keep
    if to_fit.any():
        _check_landmarks(observations)
    context = FitContext.of(body, relaxed_curls_rad(), settings, has_clothing=False)
    model = context.linearise(supplied.shape)
    state = supplied.to_fit_state(model.full_joint_indices, observations.time_s)
    rest_landmarks_m = context.regressor.points(model, state.landmark_offsets_m).rest_m[0]
    observations, left_right_swapped = _correct_left_right_swaps(observations, rest_landmarks_m)
    left_right_swapped = {sides: rows & to_fit for sides, rows in left_right_swapped.items()}
    if to_fit.any():
        parameters = with_silhouettes(EnergyParameters.from_settings(settings), settings)
        state, _, _ = _fit_poses(context, observations, windows, FitProgress(state), parameters)
    if keep:
        state = supplied.overwrite_poses(state, model.full_joint_indices)
    _, silhouette_iou = match_silhouettes(model, state, observations, windows)
    result = _result(context, model, state, observations, silhouette_iou, left_right_swapped)
    result = replace(result, shape_is_supplied=True)
    return replace(result, rotations_wxyz=supplied.overwrite_all_rotations(result.rotations_wxyz)) if keep else result


def select_shared_frames(
    observations: Observations, windows: Sequence[MaskWindow | None], count: int
) -> Int[np.ndarray, "k"]:
    """Return at most `count` evenly spaced frames with landmarks and mask (with landmarks if there are no masks)."""
    found = has_torso_landmarks(observations)
    with_mask = found & np.array([window is not None for window in windows])
    candidates = np.flatnonzero(with_mask if with_mask.sum() >= MIN_FRAMES else found)
    return candidates[evenly_spaced(len(candidates), count)]


def _check_landmarks(observations: Observations) -> None:
    if has_torso_landmarks(observations).sum() < MIN_FRAMES:
        raise TooFewLandmarksError(f"fewer than {MIN_FRAMES} frames have hips and shoulders in pixels and in 3D")


def _correct_left_right_swaps(
    observations: Observations, rest_landmarks_m: Float[Tensor, "l 3"]
) -> tuple[Observations, dict[str, Bool[np.ndarray, "n"]]]:
    """Return the observations with left-right swaps corrected, and the corrected frames by body part."""
    left_right_swapped = {"whole body": detect_body_swaps(observations, rest_landmarks_m)}
    observations = swap_body_left_right(observations, left_right_swapped["whole body"])
    for limb in LIMB_SWAP_PAIRS:
        left_right_swapped[limb] = detect_limb_swaps(observations, limb)
        observations = swap_limb_left_right(observations, left_right_swapped[limb], limb)
    return observations, left_right_swapped


def _fit_shared(
    context: FitContext,
    observations: Observations,
    windows: Sequence[MaskWindow | None],
    start: FitState,
    options: FitOptions,
    evidence: gravity.TiltEvidence | None,
) -> FitProgress:
    """Fit the shared parameters and the poses of some frames, and interpolate the poses of the others.

    The world is turned after each round, see `upright_turn`.

    evidence: of the vertical; None if it is known.
    """
    settings, time_s = options.settings, observations.time_s
    chosen = select_shared_frames(observations, windows, options.shared_frames)
    observations, windows, state = observations.select(chosen), [windows[row] for row in chosen], start.select(chosen)
    parameters = landmark_parameters(options)
    state, _ = _fit_landmarks(context, context.default, observations, parameters, state, settings.landmark_steps)
    parameters = free_parameters(options)
    model = context.linearise(state.shape)
    state, system = _fit_landmarks(context, model, observations, parameters, state, settings.landmark_steps)
    parameters = shared_parameters(options)
    posture, to_vertical = None, torch.eye(3, dtype=torch.float64)
    for number in track(range(options.rounds), "shape and focal length"):
        model, before = context.linearise(state.shape), state
        state, system, objective = _silhouette_round(
            context, model, observations, windows, parameters, state, _Recording(posture)
        )
        if number + 1 == POSTURE_ROUND:
            state = unflip_forearms(model, state, observations.camera)
            posture = objective.estimate_posture(context.pose_prior, state)
        has_converged = shared_step_ratio(before, state, system) < CONVERGED_STEP_RATIO
        if evidence is not None:
            turn = gravity.upright_turn(model, state, evidence.about(to_vertical[:, 1]), settings, observations.camera)
            state = gravity.turn_state(state, turn, torch.zeros(3, dtype=torch.float64))
            observations = gravity.turn_world(observations, turn)
            to_vertical = turn @ to_vertical
            has_converged = has_converged and float(turn[1, 1]) > np.cos(CONVERGED_TURN_RAD)
        if number + 1 > POSTURE_ROUND and has_converged:
            break
    stds = posterior_stds(context.linearise(state.shape), system)
    return FitProgress(interpolated_state(state, chosen, time_s), posture, *stds, to_vertical=to_vertical)


def _fit_poses(
    context: FitContext,
    observations: Observations,
    windows: Sequence[MaskWindow | None],
    progress: FitProgress,
    parameters: EnergyParameters,
    checkpoint: Path | None = None,
) -> tuple[FitState, LinearBody, Float[np.ndarray, "n"]]:
    """Fit the poses of all frames with the shared parameters fixed; return each frame's silhouette IoU as well.

    progress: where the fit starts. checkpoint: file that gets the progress after each round.
    """
    settings = context.settings
    parameters = replace(
        parameters,
        free_shape=False,
        free_landmark_offsets=False,
        free_focal=False,
        free_principal_point=False,
        hand_std_m=settings.fitted_hand_std_m,
        face_std_m=settings.fitted_face_std_m,
    )
    state, posture = progress.state, progress.posture
    model = context.linearise(state.shape)
    if progress.rounds_done == 0:
        landmarks_only = replace(
            parameters, landmark_std_m=settings.landmark_std_m, landmark_3d_std_m=settings.landmark_3d_std_m
        )
        state, _ = _fit_landmarks(context, model, observations, landmarks_only, state, settings.silhouette_steps)
    recording = _Recording(posture, progress.motion_std)
    done = progress.rounds_done
    for number in track(range(done, settings.pose_rounds), "poses", initial=done):
        contact = estimate_floor_contact(
            model, state.rotations, state.root_m, observations.confidence, observations.time_s
        )
        state, _, _ = _silhouette_round(
            context, model, observations, windows, parameters, state, replace(recording, contact=contact)
        )
        root_perspective = world_to_perspective(state.root_m, observations.camera)
        motion_std = estimate_motion_std(state.rotations, root_perspective, observations.time_s)
        recording = _Recording(posture, motion_std)
        save_progress(checkpoint, replace(progress, state=state, rounds_done=number + 1, motion_std=motion_std))
    _, silhouette_iou = match_silhouettes(model, state, observations, windows, context.hem)
    return state, model, silhouette_iou


def _silhouette_round(
    context: FitContext,
    model: LinearBody,
    observations: Observations,
    windows: Sequence[MaskWindow | None],
    parameters: EnergyParameters,
    state: FitState,
    recording: _Recording,
) -> tuple[FitState, NormalEquations, Objective]:
    """Match the silhouettes of the current body, then minimise the energy; return the objective as well."""
    contour, _ = match_silhouettes(model, state, observations, windows, context.hem)
    objective = Objective(
        model,
        context.regressor,
        prior_of_recording(context.pose_prior, recording.posture, state.rotations, observations.time_s),
        context.shape_prior,
        observations,
        parameters,
        compute_px_per_m(state, observations.camera),
        contour,
        recording.motion_std,
        recording.contact,
    )
    return *minimise(state, objective, objective.retract, context.settings.silhouette_steps), objective


def _fit_landmarks(
    context: FitContext,
    model: LinearBody,
    observations: Observations,
    parameters: EnergyParameters,
    state: FitState,
    steps: int,
) -> tuple[FitState, NormalEquations]:
    """Minimise the energy without silhouettes."""
    objective = Objective(
        model,
        context.regressor,
        context.pose_prior,
        context.shape_prior,
        observations,
        parameters,
        compute_px_per_m(state, observations.camera),
    )
    return minimise(state, objective, objective.retract, steps)


def _result(
    context: FitContext,
    model: LinearBody,
    state: FitState,
    observations: Observations,
    silhouette_iou: Float[np.ndarray, "n"],
    left_right_swapped: dict[str, Bool[np.ndarray, "n"]],
) -> FitResult:
    """Return the result with zero standard deviations."""
    quaternions = matrix_to_quaternion(model.all_joint_rotations(state.rotations))
    return FitResult(
        body=context.filled_body(model),
        bare=context.bare_body(model),
        rotations_wxyz=continuous_quaternions(quaternions).float().numpy(),
        root_translation_m=state.root_m.float().numpy(),
        camera=apply_intrinsics_delta(observations.camera, state.intrinsics_delta),
        landmark_error_px=landmark_errors_px(context.regressor, model, state, observations),
        silhouette_iou=silhouette_iou,
        left_right_swapped=left_right_swapped,
        focal_relative_std=0.0,
        height_std_m=0.0,
        lean_deg=gravity.lean_deg(model, state),
    )
