"""What a fit minimises: landmarks, silhouette, pose, motion and shape terms, as one system of normal equations.

All residuals are in standard deviations. Distances in the image are judged in metres at the person's depth, so that
the weights hold for any resolution. Robust terms use Geman-McClure, rho(r) = r^2 / (1 + r^2 / c^2) (Barron 2019).
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pipeline.body.fit.camera_parameters import LENS_COUNT, pixels_by_lens, project_with_covectors, through_lens
from pipeline.body.fit.ground_contact import Contact, add_contact
from pipeline.body.fit.landmark_regressor import (
    LANDMARK_COUNT,
    OFFSET_COUNT,
    POSE_LANDMARKS,
    LandmarkRegressor,
    landmark_noise,
)
from pipeline.body.fit.levenberg_marquardt import NormalEquations, robust_weights
from pipeline.body.fit.linear_body import (
    ACTIVE_JOINTS,
    FitModel,
    Points,
    PosedSkeleton,
    pose_points,
    pose_rows,
    pose_skeleton,
    shape_rows,
    surface_points,
)
from pipeline.body.fit.priors import (
    JointPrior,
    ShapePrior,
    interval_factors,
    motion_residuals,
    pose_residuals,
    usual_motion,
)
from pipeline.body.fit.root_placement import place_of_root, root_by_place, root_of_place
from pipeline.geometry.camera import Camera
from pipeline.geometry.rotation import axis_angle_to_matrix

FACE_LANDMARKS = 11
LEFT_HIP, RIGHT_HIP = 23, 24
SCALE_PASSES = 3
DEPTH_NOISE = 2.0
"""How much worse the detector knows a landmark's depth than its place across the view."""
LEAST_DEPTH, MOST_DEPTH = 0.4, 1.2
"""Range of the detector's scale of depths over its scale across the view."""


@dataclass(frozen=True)
class FitState:
    """The unknowns; `lens` as in `pipeline.body.fit.camera_parameters`."""

    rotations: Float[Tensor, "n j 3 3"]
    root_m: Float[Tensor, "n 3"]
    shape: Float[Tensor, "s"]
    offsets_m: Float[Tensor, "o"]
    lens: Float[Tensor, "3"]

    def moved(self, frame_step: Float[Tensor, "n p"], shared_step: Float[Tensor, "g"], camera: Camera) -> "FitState":
        """The state after a step; an empty shared step leaves what is shared as it is."""
        turn = axis_angle_to_matrix(frame_step[:, :-3].reshape(*self.rotations.shape[:2], 3))
        place = place_of_root(self.root_m, camera) + frame_step[:, -3:]
        moved = replace(self, rotations=turn @ self.rotations, root_m=root_of_place(place, camera))
        if len(shared_step) == 0:
            return moved
        shapes = len(self.shape)
        return replace(
            moved,
            shape=self.shape + shared_step[:shapes],
            offsets_m=self.offsets_m + shared_step[shapes:-LENS_COUNT],
            lens=self.lens + shared_step[-LENS_COUNT:],
        )

    def rows(self, rows: Int[np.ndarray, "k"]) -> "FitState":
        """The poses of some frames."""
        return replace(self, rotations=self.rotations[rows], root_m=self.root_m[rows])


@dataclass(frozen=True)
class Observations:
    """What was seen. `directions_m` are landmarks in world axes relative to the middle of the hips, of unknown overall
    scale. `confidence` of pixels and of directions is in [0, 1], 0 where there is none; no value is nan."""

    time_s: Float[Tensor, "n"]
    landmarks_px: Float[Tensor, "n l 2"]
    directions_m: Float[Tensor, "n l 3"]
    confidence: Float[Tensor, "n l"]
    direction_confidence: Float[Tensor, "n l"]
    camera: Camera

    def rows(self, rows: Int[np.ndarray, "k"]) -> "Observations":
        """What was seen in some frames."""
        return replace(
            self,
            time_s=self.time_s[rows],
            landmarks_px=self.landmarks_px[rows],
            directions_m=self.directions_m[rows],
            confidence=self.confidence[rows],
            direction_confidence=self.direction_confidence[rows],
        )


@dataclass(frozen=True)
class Contour:
    """Points of the body that belong on a line in the image: normal · (projection - target) = 0; weight 0: unused."""

    corners: Int[Tensor, "n m 3"]
    barycentric: Float[Tensor, "n m 3"]
    target_px: Float[Tensor, "n m 2"]
    normal: Float[Tensor, "n m 2"]
    weight: Float[Tensor, "n m"]


@dataclass(frozen=True)
class Weights:
    """Standard deviations of the terms, what robust ones are cut off at (in deviations), and which shared numbers move.

    `landmark_m`, `hand_m` and `contour_m` are metres at the person, `direction_m` is on the detector's 3D landmarks,
    `motion` a factor on `Objective.motion`, `focal_log` of the focal length's logarithm, `centre` in focal lengths.
    """

    landmark_m: float = 0.025
    hand_m: float = 0.060
    landmark_cutoff: float = 3.0
    direction_m: float = 0.08
    contour_m: float = 0.010
    contour_cutoff: float = 4.0
    motion: float = 1.0
    motion_cutoff: float = 4.0
    offset_m: float = 0.012
    height_m: float = 1.70
    height_deviation_m: float = 0.02
    focal_log: float = 0.5
    centre: float = 0.05
    free_shape: bool = True
    free_offsets: bool = False
    free_focal: bool = False
    free_centre: bool = False

    def landmarks_m(self) -> Float[Tensor, "l"]:
        """Standard deviation of each landmark in the image, metres at the person."""
        deviation = self.landmark_m * landmark_noise()
        deviation[POSE_LANDMARKS:] = self.hand_m
        return deviation

    def anything_shared(self) -> bool:
        """Whether any number that all frames share may move."""
        return self.free_shape or self.free_offsets or self.free_focal or self.free_centre


@dataclass(frozen=True)
class Objective:
    """All terms at hand; call it with a state.

    `px_per_m` is the image scale at each frame's person, held fixed while the state moves. `motion` are standard
    deviations of `motion_residuals`; None: `usual_motion`, which fast people need. `contact` needs all that is
    shared to be fixed.
    """

    model: FitModel
    regressor: LandmarkRegressor
    joint_prior: JointPrior
    shape_prior: ShapePrior
    observations: Observations
    weights: Weights
    px_per_m: Float[Tensor, "n"]
    contour: Contour | None = None
    motion: Float[Tensor, "p"] | None = None
    contact: Contact | None = None

    def __call__(self, state: FitState) -> NormalEquations:
        """The normal equations of all terms at a state."""
        model = self.model.moved(state.shape)
        frames, joints = state.rotations.shape[:2]
        shapes = len(state.shape)
        shared = shapes + OFFSET_COUNT + LENS_COUNT if self.weights.anything_shared() else 0
        system = NormalEquations.zeros(frames, 3 * joints + 3, shared)
        skeleton = pose_skeleton(model, state.rotations, state.root_m)
        self._add_landmarks(system, model, skeleton, state)
        if self.contour is not None:
            self._add_contour(system, model, skeleton, state, self.contour)
        if self.contact is not None:
            add_contact(system, model, skeleton, state.root_m, self.observations.camera, self.contact)
        self._add_pose(system, state)
        self._add_motion(system, state)
        if shared:
            self._add_shared(system, model, state)
            system.freeze(self._free(shapes))
        return system

    def retract(self, state: FitState, frame_step: Tensor, shared_step: Tensor) -> FitState:
        """The state after a step, its shape inside the allowed range."""
        moved = state.moved(frame_step, shared_step, self.observations.camera)
        return replace(moved, shape=moved.shape.clamp(self.shape_prior.lowest, self.shape_prior.highest))

    def _free(self, shapes: int) -> Bool[Tensor, "g"]:
        free = torch.ones(shapes + OFFSET_COUNT + LENS_COUNT, dtype=torch.bool)
        free[:shapes], free[shapes:-LENS_COUNT] = self.weights.free_shape, self.weights.free_offsets
        free[-LENS_COUNT:-1], free[-1] = self.weights.free_centre, self.weights.free_focal
        return free

    def _add_landmarks(
        self, system: NormalEquations, model: FitModel, skeleton: PosedSkeleton, state: FitState
    ) -> None:
        seen, weights = self.observations, self.weights
        points = self.regressor.points(model, state.offsets_m)
        world, arms = pose_points(model, skeleton, points)
        pixels, covectors = project_with_covectors(world, through_lens(seen.camera, state.lens))
        by_lens = pixels_by_lens(pixels, seen.camera, state.lens)
        noise = landmark_noise()
        facing = facing_factor(skeleton, seen.camera)
        confidence = seen.confidence * facing
        inverse = confidence.sqrt() / (weights.landmarks_m() * self.px_per_m[:, None])
        residual = (pixels - seen.landmarks_px) * inverse[..., None]
        weight = robust_weights(system, residual.square().sum(-1), weights.landmark_cutoff)
        by_place = root_by_place(state.root_m, seen.camera)
        for axis in range(2):
            covector = covectors[:, :, axis] * inverse[..., None]
            by_shared = self._shared_rows(model, skeleton, points, covector, by_lens[:, :, axis] * inverse[..., None])
            system.add(pose_rows(skeleton, arms, by_place, covector), by_shared, residual[..., axis], weight)
        trust = seen.direction_confidence * facing / noise.square()
        self._add_directions(system, model, skeleton, points, world, arms, trust)

    def _add_directions(
        self,
        system: NormalEquations,
        model: FitModel,
        skeleton: PosedSkeleton,
        points: Points,
        world: Float[Tensor, "n l 3"],
        arms: Float[Tensor, "n l j 3"],
        confidence: Float[Tensor, "n l"],
    ) -> None:
        """The detector's 3D landmarks, relative to the hips, in camera axes and of unknown scale."""
        seen, cutoff = self.observations, self.weights.landmark_cutoff
        to_camera = torch.as_tensor(seen.camera.world_to_camera, dtype=world.dtype)[:3, :3]
        relative, found = (world - _hip_middle(world)) @ to_camera.T, seen.directions_m @ to_camera.T
        deviation = self.weights.direction_m * world.new_tensor([1.0, 1.0, DEPTH_NOISE])
        inverse = confidence.sqrt()[..., None] / deviation
        scale = direction_scale(relative, found, inverse, cutoff)
        residual = (scale * relative - found) * inverse
        weight = robust_weights(system, residual.square().sum(-1), cutoff)
        by_place = torch.zeros(len(world), 3, 3, dtype=torch.float64)  # hips and landmarks move together
        for axis in range(3):
            covector = (scale[axis] * to_camera[axis]).expand_as(world)
            rows = pose_rows(skeleton, arms, by_place, covector)
            shared = self._shared_rows(model, skeleton, points, covector, world.new_zeros(*world.shape[:2], LENS_COUNT))
            rows = (rows - _hip_middle(rows)) * inverse[..., axis, None]
            shared = (shared - _hip_middle(shared)) * inverse[..., axis, None]
            system.add(rows, shared, residual[..., axis], weight)

    def _add_contour(
        self, system: NormalEquations, model: FitModel, skeleton: PosedSkeleton, state: FitState, contour: Contour
    ) -> None:
        seen = self.observations
        points = surface_points(model, contour.corners, contour.barycentric)
        world, arms = pose_points(model, skeleton, points)
        pixels, covectors = project_with_covectors(world, through_lens(seen.camera, state.lens))
        inverse = 1.0 / (self.px_per_m[:, None] * self.weights.contour_m)
        residual = ((pixels - contour.target_px) * contour.normal).sum(-1) * inverse
        weight = contour.weight * robust_weights(system, residual.square(), self.weights.contour_cutoff, contour.weight)
        normal, inverse = contour.normal[..., None], inverse[..., None]
        covector = (covectors * normal).sum(2) * inverse
        by_lens = (pixels_by_lens(pixels, seen.camera, state.lens) * normal).sum(2) * inverse
        by_shared = self._shared_rows(model, skeleton, points, covector, by_lens)
        by_place = root_by_place(state.root_m, seen.camera)
        system.add(pose_rows(skeleton, arms, by_place, covector), by_shared, residual, weight)

    def _shared_rows(
        self,
        model: FitModel,
        skeleton: PosedSkeleton,
        points: Points,
        covector: Float[Tensor, "n m 3"],
        by_lens: Float[Tensor, "n m 3"],
    ) -> Float[Tensor, "n m g"]:
        """Derivative of covector · point by shape, landmark offsets and lens; no columns when all are fixed."""
        if not self.weights.anything_shared():
            return covector[..., :0]
        by_shape = shape_rows(model, skeleton, points, covector)
        missing = len(model.shape) + OFFSET_COUNT - by_shape.shape[-1]
        offsets = by_shape.new_zeros(*by_shape.shape[:2], missing)
        return torch.cat([by_shape, offsets, by_lens], dim=-1)

    def _add_pose(self, system: NormalEquations, state: FitState) -> None:
        residual, derivative = pose_residuals(self.joint_prior, state.rotations)
        system.cost += float(residual.square().sum())
        gradient = (derivative.transpose(-1, -2) @ residual[..., None]).squeeze(-1)
        system.frame_gradient[:, :-3] += gradient.flatten(1)
        blocks = derivative.transpose(-1, -2) @ derivative
        for joint in range(blocks.shape[1]):
            span = slice(3 * joint, 3 * joint + 3)
            system.frame[:, span, span] += blocks[:, joint]

    def _add_motion(self, system: NormalEquations, state: FitState) -> None:
        if len(state.root_m) < 3:
            return
        weights, time_s = self.weights, self.observations.time_s
        residual = motion_residuals(state.rotations, place_of_root(state.root_m, self.observations.camera), time_s)
        deviation = usual_motion(state.rotations.shape[1]) if self.motion is None else self.motion
        residual = residual / (weights.motion * deviation)
        weight = robust_weights(system, residual.square(), weights.motion_cutoff)
        before, after, scale = (factor[:, None] for factor in interval_factors(time_s))
        factors = (before * scale / deviation, -(before + after) * scale / deviation, after * scale / deviation)
        diagonal = torch.diagonal(system.frame, dim1=1, dim2=2)
        inner = len(residual)
        for shift, factor in enumerate(factors):
            diagonal[shift : shift + inner] += weight * factor**2
            system.frame_gradient[shift : shift + inner] += weight * factor * residual
        system.next_frame[:inner] += weight * factors[0] * factors[1]
        system.next_frame[1 : inner + 1] += weight * factors[1] * factors[2]
        system.after_next_frame[:inner] += weight * factors[0] * factors[2]

    def _add_shared(self, system: NormalEquations, model: FitModel, state: FitState) -> None:
        """Priors on shape, stature, landmark offsets and lens."""
        weights, shapes = self.weights, len(state.shape)
        deviation = torch.cat(
            [
                self.shape_prior.deviation,
                torch.full((OFFSET_COUNT,), weights.offset_m, dtype=torch.float64),
                torch.tensor([weights.centre, weights.centre, weights.focal_log], dtype=torch.float64),
            ]
        )
        value = torch.cat([state.shape - self.shape_prior.mean, state.offsets_m, state.lens]) / deviation
        system.cost += float(value.square().sum())
        system.shared += torch.diag(deviation**-2)
        system.shared_gradient += value / deviation
        height_m, gradient = model.height_m()
        gradient = gradient / weights.height_deviation_m
        residual = (height_m - weights.height_m) / weights.height_deviation_m
        system.cost += residual**2
        system.shared[:shapes, :shapes] += torch.outer(gradient, gradient)
        system.shared_gradient[:shapes] += gradient * residual


def facing_factor(skeleton: PosedSkeleton, camera: Camera) -> Float[Tensor, "n l"]:
    """Trust in each landmark by where the head looks: a face found on the back of a head is the detector's guess."""
    head = ACTIVE_JOINTS.index("Head")
    to_camera = torch.nn.functional.normalize(
        torch.as_tensor(camera.centre_m(), dtype=torch.float64) - skeleton.position[:, head], dim=-1
    )
    cosine = (skeleton.rotation[:, head, :, 2] * to_camera).sum(-1)
    factor = torch.ones(len(cosine), LANDMARK_COUNT, dtype=torch.float64)
    factor[:, :FACE_LANDMARKS] = (0.5 + 2.0 * cosine).clamp(0.05, 1.0)[:, None]
    return factor


def direction_scale(
    relative_m: Float[Tensor, "n l 3"],
    directions_m: Float[Tensor, "n l 3"],
    inverse: Float[Tensor, "n l 3"],
    cutoff: float,
) -> Float[Tensor, "3"]:
    """Factors (across, across, depth; camera axes) that carry the body's 3D landmarks onto the detector's with the
    least robust cost. The detector makes people flatter than they are, so depth has a factor of its own.

    Being the best factors, their own change costs nothing to first order, so the derivatives take them as constant.
    """
    weight, scale = inverse.square(), relative_m.new_ones(3)
    for _ in range(SCALE_PASSES):
        above, below = ((weight * relative_m * other).sum((0, 1)) for other in (directions_m, relative_m))
        across = above[:2].sum() / below[:2].sum()
        depth = (above[2] / below[2]).clamp(LEAST_DEPTH * across, MOST_DEPTH * across)
        scale = torch.stack([across, across, depth])
        squared = ((scale * relative_m - directions_m) * inverse).square().sum(-1)
        weight = inverse.square() * ((1.0 + squared / cutoff**2) ** -2)[..., None]
    return scale


def image_scale(state: FitState, camera: Camera) -> Float[Tensor, "n"]:
    """Pixels a metre at each frame's person."""
    return through_lens(camera, state.lens).fx * torch.exp(-place_of_root(state.root_m, camera)[:, 2])


def _hip_middle(values: Float[Tensor, "n l c"]) -> Float[Tensor, "n 1 c"]:
    return 0.5 * (values[:, LEFT_HIP] + values[:, RIGHT_HIP])[:, None]
