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
from pipeline.body.fit.camera_parameters import project_with_covectors, through_lens
from pipeline.body.fit.energy import FitState, Objective, Observations, Weights, image_scale
from pipeline.body.fit.ground_contact import Contact, floor_contact
from pipeline.body.fit.initialisation import initial_state, interpolated_state, torso_found
from pipeline.body.fit.landmark_regressor import POSE_LANDMARKS, LandmarkRegressor, landmark_regressor
from pipeline.body.fit.left_right_swaps import LIMBS, exchange_bodies, exchange_limbs, exchanged_bodies, exchanged_limbs
from pipeline.body.fit.levenberg_marquardt import NormalEquations, minimise, shared_covariance
from pipeline.body.fit.linear_body import FitModel, linearise, pose_points, pose_skeleton, relaxed_curls
from pipeline.body.fit.priors import JointPrior, ShapePrior, habitual_prior, joint_prior, observed_motion, shape_prior
from pipeline.body.fit.root_placement import place_of_root
from pipeline.body.fit.silhouette_icp import Window, match_all
from pipeline.body.fit.supplied_poses import GivenPoses
from pipeline.core.progress import track
from pipeline.geometry.camera import Camera
from pipeline.geometry.rotation import continuous_quaternions, matrix_to_quaternion

MINIMUM_FRAMES = 3
LANDMARK_STEPS = 12
OUTLINE_STEPS = 3
POSE_ROUNDS = 3
STATURE_DEVIATION_M = 0.09
"""Spread of adults' stature, which is how well an assumed one is known."""
OUTLINE_LANDMARK_M = 0.06
OUTLINE_DIRECTION_M = 0.4
"""Standard deviations of a landmark in the image and in 3D once outlines help, which err less and in no fixed way."""


class TooFewLandmarksError(ValueError):
    """The frames do not say enough of the person's place to begin a fit."""


WELL_SEEN = 0.5
"""Trust from which a landmark's distance tells how good a fit is."""

HAND_M = 0.012
"""Standard deviation of a hand's points once the shape is known; before, the body's own errors are larger."""


@dataclass(frozen=True)
class FitOptions:
    """`height_m` and deviations of 0 take unknowns away; `shared_frames` and `rounds` are the effort.

    focal_deviation: standard deviation of the logarithm of the true focal length over the one to start from.
    centre_deviation: standard deviation of the principal point about the one to start from, in focal lengths.
    """

    height_m: float | None = None
    focal_deviation: float = 0.5
    centre_deviation: float = 0.0
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
    overlap: Float[np.ndarray, "n"]
    exchanged: dict[str, Bool[np.ndarray, "n"]]
    focal_deviation: float
    height_deviation_m: float


@dataclass(frozen=True)
class _Tools:
    """What does not change during a fit."""

    body: ParametricBody
    regressor: LandmarkRegressor
    joint_prior: JointPrior
    shape_prior: ShapePrior
    default: FitModel
    curls_rad: Float[np.ndarray, "2 4"]

    def model(self, shape: Float[Tensor, "s"]) -> FitModel:
        """The body around a shape."""
        return linearise(self.body, shape, self.curls_rad)


def fit_body(
    body: ParametricBody,
    observations: Observations,
    windows: Sequence[Window | None],
    options: FitOptions,
    curls_rad: Float[np.ndarray, "2 4"] | None = None,
) -> FitResult:
    """Fit a body to landmarks and masks.

    observations.camera holds the focal length to start from. Windows come from `fit_silhouette.matching_window`,
    curls_rad from `fit_hands.finger_curls_rad` (None: a relaxed grip).
    Raises ValueError when fewer than three frames have a torso in pixels and in 3D.
    """
    _check_landmarks(observations)
    tools = _tools(body, relaxed_curls() if curls_rad is None else curls_rad)
    rest_m = tools.regressor.points(tools.default, torch.zeros(_offsets(tools), dtype=torch.float64)).rest[0]
    observations, exchanged = _with_sides_mended(observations, rest_m)
    start = initial_state(observations, rest_m, tools.default.joints, body.shape_defaults.double(), _offsets(tools))
    chosen = shared_rows(observations, windows, options.shared_frames)
    state, weights, system = _fit_shared(
        tools, observations.rows(chosen), [windows[row] for row in chosen], start.rows(chosen), options
    )
    state = interpolated_state(state, chosen, observations.time_s)
    state, model, overlap = _fit_poses(tools, observations, windows, state, weights)
    spread_m = STATURE_DEVIATION_M if options.height_m is None else 0.0
    return _result(tools, model, state, system, observations, overlap, exchanged, spread_m)


def fit_given(
    body: ParametricBody,
    observations: Observations,
    windows: Sequence[Window | None],
    given: GivenPoses,
    keep: bool,
) -> FitResult:
    """Take over shape and poses that others fitted; frames that they lack are fitted, from between their neighbours.

    observations.camera is the camera that the given poses belong to.
    keep: the given poses stay as they are; else every pose goes on from them to landmarks and outlines.
    Raises ValueError when no frame has a pose, or as `fit_body` does where a frame is fitted.
    """
    to_fit = np.ones(len(windows), dtype=bool)
    to_fit[given.rows] = not keep
    if to_fit.any():
        _check_landmarks(observations)
    tools = _tools(body, relaxed_curls())
    model = tools.model(given.shape)
    state = given.state(model.full_joint, observations.time_s)
    rest_m = tools.regressor.points(model, state.offsets_m).rest[0]
    observations, exchanged = _with_sides_mended(observations, rest_m)
    exchanged = {sides: rows & to_fit for sides, rows in exchanged.items()}
    if to_fit.any():
        weights = Weights(landmark_m=OUTLINE_LANDMARK_M, direction_m=OUTLINE_DIRECTION_M)
        state, _, _ = _fit_poses(tools, observations, windows, state, weights)
    if keep:
        state = given.put_into(state, model.full_joint)
    _, overlap = match_all(model, state, observations, windows)
    result = _result(tools, model, state, None, observations, overlap, exchanged, 0.0)
    return replace(result, rotations_wxyz=given.put_into_all(result.rotations_wxyz)) if keep else result


def shared_rows(observations: Observations, windows: Sequence[Window | None], count: int) -> Int[np.ndarray, "k"]:
    """Frames for the shared unknowns: evenly spread over those with landmarks and mask (without masks: landmarks)."""
    found = torso_found(observations)
    with_mask = found & np.array([window is not None for window in windows])
    candidates = np.flatnonzero(with_mask if with_mask.sum() >= MINIMUM_FRAMES else found)
    return np.unique(candidates[np.linspace(0, len(candidates) - 1, min(count, len(candidates))).astype(np.int64)])


def _check_landmarks(observations: Observations) -> None:
    if torso_found(observations).sum() < MINIMUM_FRAMES:
        raise TooFewLandmarksError(f"fewer than {MINIMUM_FRAMES} frames have hips and shoulders in pixels and in 3D")


def _tools(body: ParametricBody, curls_rad: Float[np.ndarray, "2 4"]) -> _Tools:
    default = linearise(body, body.shape_defaults, curls_rad)
    return _Tools(
        body,
        landmark_regressor(default),
        joint_prior(default),
        shape_prior(body.shape_names, body.shape_defaults),
        default,
        curls_rad,
    )


def _offsets(tools: _Tools) -> int:
    return tools.regressor.by_offset.shape[-1]


def _with_sides_mended(
    observations: Observations, rest_m: Float[Tensor, "l 3"]
) -> tuple[Observations, dict[str, Bool[np.ndarray, "n"]]]:
    """Observations with exchanged sides put right, and in which frames that happened."""
    exchanged = {"whole body": exchanged_bodies(observations, rest_m)}
    observations = exchange_bodies(observations, exchanged["whole body"])
    for limb in LIMBS:
        exchanged[limb] = exchanged_limbs(observations, limb)
        observations = exchange_limbs(observations, exchanged[limb], limb)
    return observations, exchanged


def _fit_shared(
    tools: _Tools,
    observations: Observations,
    windows: Sequence[Window | None],
    state: FitState,
    options: FitOptions,
) -> tuple[FitState, Weights, NormalEquations]:
    """Shape, focal length and landmark offsets (with the poses of these frames), and the last normal equations."""
    weights = Weights() if options.height_m is None else Weights(height_m=options.height_m, height_deviation_m=0.005)
    state, _ = _minimised(tools, tools.default, observations, weights, state, LANDMARK_STEPS)
    weights = replace(weights, free_offsets=True)
    if options.focal_deviation > 0.0:
        weights = replace(weights, free_focal=True, focal_log=options.focal_deviation)
    if options.centre_deviation > 0.0:
        weights = replace(weights, free_centre=True, centre=options.centre_deviation)
    model = tools.model(state.shape)
    state, system = _minimised(tools, model, observations, weights, state, LANDMARK_STEPS)
    weights = replace(weights, landmark_m=OUTLINE_LANDMARK_M, direction_m=OUTLINE_DIRECTION_M)
    for _ in track(range(options.rounds), "shape and focal length"):
        model = tools.model(state.shape)
        state, system, _ = _outline_round(tools, model, observations, windows, weights, state)
    return state, weights, system


def _fit_poses(
    tools: _Tools,
    observations: Observations,
    windows: Sequence[Window | None],
    state: FitState,
    weights: Weights,
) -> tuple[FitState, FitModel, Float[np.ndarray, "n"]]:
    """The pose of every frame with all that is shared held fixed, and each frame's overlap with its mask."""
    weights = replace(weights, free_shape=False, free_offsets=False, free_focal=False, free_centre=False, hand_m=HAND_M)
    model = tools.model(state.shape)
    landmarks_only = replace(weights, landmark_m=Weights.landmark_m, direction_m=Weights.direction_m)
    state, _ = _minimised(tools, model, observations, landmarks_only, state, OUTLINE_STEPS)
    motion = None
    for _ in track(range(POSE_ROUNDS), "poses"):
        contact = floor_contact(model, state.rotations, state.root_m, observations.confidence, observations.time_s)
        state, _, _ = _outline_round(tools, model, observations, windows, weights, state, motion, contact)
        place = place_of_root(state.root_m, observations.camera)
        motion = observed_motion(state.rotations, place, observations.time_s)
    _, overlap = match_all(model, state, observations, windows)
    return state, model, overlap


def _outline_round(
    tools: _Tools,
    model: FitModel,
    observations: Observations,
    windows: Sequence[Window | None],
    weights: Weights,
    state: FitState,
    motion: Float[Tensor, "p"] | None = None,
    contact: Contact | None = None,
) -> tuple[FitState, NormalEquations, Float[np.ndarray, "n"]]:
    """Pair outlines for the body as it stands, then move it."""
    contour, overlap = match_all(model, state, observations, windows)
    objective = Objective(
        model,
        tools.regressor,
        habitual_prior(tools.joint_prior, state.rotations),
        tools.shape_prior,
        observations,
        weights,
        image_scale(state, observations.camera),
        contour,
        motion,
        contact,
    )
    state, system = minimise(state, objective, objective.retract, OUTLINE_STEPS)
    return state, system, overlap


def _minimised(
    tools: _Tools, model: FitModel, observations: Observations, weights: Weights, state: FitState, steps: int
) -> tuple[FitState, NormalEquations]:
    """Fit to landmarks alone."""
    objective = Objective(
        model,
        tools.regressor,
        tools.joint_prior,
        tools.shape_prior,
        observations,
        weights,
        image_scale(state, observations.camera),
    )
    return minimise(state, objective, objective.retract, steps)


def landmark_errors_px(
    regressor: LandmarkRegressor, model: FitModel, state: FitState, observations: Observations
) -> Float[np.ndarray, "n"]:
    """Median distance of each frame's well-seen pose landmarks from the body's, of all that are known where none is
    well seen; nan without any.
    """
    skeleton = pose_skeleton(model, state.rotations, state.root_m)
    world, _ = pose_points(model, skeleton, regressor.points(model, state.offsets_m))
    pixels, _ = project_with_covectors(world, through_lens(observations.camera, state.lens))
    error = (pixels - observations.landmarks_px).norm(dim=-1)[:, :POSE_LANDMARKS]
    trust = observations.confidence[:, :POSE_LANDMARKS]
    well_seen = trust > WELL_SEEN
    counted = torch.where(well_seen.any(1, keepdim=True), well_seen, trust > 0.0)
    return torch.where(counted, error, torch.nan).nanmedian(1).values.numpy()


def _result(
    tools: _Tools,
    model: FitModel,
    state: FitState,
    system: NormalEquations | None,
    observations: Observations,
    overlap: Float[np.ndarray, "n"],
    exchanged: dict[str, Bool[np.ndarray, "n"]],
    stature_spread_m: float,
) -> FitResult:
    focal_deviation, height_deviation_m = (0.0, 0.0) if system is None else _deviations(model, system)
    quaternions = matrix_to_quaternion(model.rotations_of_all(state.rotations))
    return FitResult(
        body=tools.body.body(state.shape.float()),
        rotations_wxyz=continuous_quaternions(quaternions).float().numpy(),
        root_translation_m=state.root_m.float().numpy(),
        camera=through_lens(observations.camera, state.lens),
        landmark_error_px=landmark_errors_px(tools.regressor, model, state, observations),
        overlap=overlap,
        exchanged=exchanged,
        focal_deviation=focal_deviation,
        height_deviation_m=float(np.hypot(height_deviation_m, stature_spread_m)),
    )


def _deviations(model: FitModel, system: NormalEquations) -> tuple[float, float]:
    """Of the logarithm of the focal length, and of the stature (m)."""
    covariance, gradient = shared_covariance(system), model.height_m()[1].numpy()
    variance = gradient @ covariance[: len(gradient), : len(gradient)] @ gradient
    focal = float(np.sqrt(covariance[-1, -1])) if system.border[..., -1].any() else 0.0
    return focal, float(np.sqrt(variance))
