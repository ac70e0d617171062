"""What a fit minimises: landmarks, silhouette, pose, motion and shape terms, as one system of normal equations.

All residuals are in standard deviations. Distances in the image are judged in metres at the person's depth, so that
the weights hold for any resolution. Robust terms use Geman-McClure, rho(r) = r^2 / (1 + r^2 / c^2) (Barron 2019).
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pipeline.body.fit.camera_parameters import (
    INTRINSICS_COUNT,
    apply_intrinsics_delta,
    compute_intrinsics_jacobian,
    project_with_jacobian,
)
from pipeline.body.fit.ground_contact import Contact, add_contact_term
from pipeline.body.fit.landmark_regressor import (
    LANDMARK_COUNT,
    LANDMARK_OFFSET_COUNT,
    POSE_LANDMARK_COUNT,
    LandmarkRegressor,
    landmark_std_ratio,
)
from pipeline.body.fit.levenberg_marquardt import NormalEquations, robust_weights
from pipeline.body.fit.linear_body import (
    ACTIVE_JOINTS,
    LinearBody,
    PosedSkeleton,
    SkinnedPoints,
    pose_jacobian_rows,
    pose_points,
    pose_skeleton,
    shape_jacobian_rows,
    surface_points,
)
from pipeline.body.fit.priors import (
    PosePrior,
    ShapePrior,
    acceleration_factors,
    default_motion_std,
    motion_residuals,
    pose_residuals,
)
from pipeline.body.fit.root_placement import perspective_to_world, root_jacobian, world_to_perspective
from pipeline.geometry.camera import Camera
from pipeline.geometry.rotation import axis_angle_to_matrix

FACE_LANDMARK_COUNT = 11
LEFT_HIP, RIGHT_HIP = 23, 24
SCALE_ITERATIONS = 3
DEPTH_STD_RATIO = 2.0
"""How much worse the detector knows a landmark's depth than its place across the view."""
MIN_DEPTH_SCALE_RATIO, MAX_DEPTH_SCALE_RATIO = 0.4, 1.2
"""Range of the detector's scale of depths over its scale across the view."""


@dataclass(frozen=True)
class FitState:
    """The unknowns; `intrinsics_delta` as in `pipeline.body.fit.camera_parameters`."""

    rotations: Float[Tensor, "n j 3 3"]
    root_m: Float[Tensor, "n 3"]
    shape: Float[Tensor, "s"]
    landmark_offsets_m: Float[Tensor, "o"]
    intrinsics_delta: Float[Tensor, "3"]

    def moved(self, frame_step: Float[Tensor, "n p"], shared_step: Float[Tensor, "g"], camera: Camera) -> "FitState":
        """The state after a step; an empty shared step leaves what is shared as it is."""
        turn = axis_angle_to_matrix(frame_step[:, :-3].reshape(*self.rotations.shape[:2], 3))
        root_perspective = world_to_perspective(self.root_m, camera) + frame_step[:, -3:]
        moved = replace(self, rotations=turn @ self.rotations, root_m=perspective_to_world(root_perspective, camera))
        if len(shared_step) == 0:
            return moved
        shapes = len(self.shape)
        return replace(
            moved,
            shape=self.shape + shared_step[:shapes],
            landmark_offsets_m=self.landmark_offsets_m + shared_step[shapes:-INTRINSICS_COUNT],
            intrinsics_delta=self.intrinsics_delta + shared_step[-INTRINSICS_COUNT:],
        )

    def rows(self, rows: Int[np.ndarray, "k"]) -> "FitState":
        """The poses of some frames."""
        return replace(self, rotations=self.rotations[rows], root_m=self.root_m[rows])


@dataclass(frozen=True)
class Observations:
    """What was seen. `landmarks_3d_m` are landmarks in world axes relative to the middle of the hips, of unknown
    overall
    scale. `confidence` of pixels and of directions is in [0, 1], 0 where there is none; no value is nan."""

    time_s: Float[Tensor, "n"]
    landmarks_px: Float[Tensor, "n l 2"]
    landmarks_3d_m: Float[Tensor, "n l 3"]
    confidence: Float[Tensor, "n l"]
    confidence_3d: Float[Tensor, "n l"]
    camera: Camera

    def rows(self, rows: Int[np.ndarray, "k"]) -> "Observations":
        """What was seen in some frames."""
        return replace(
            self,
            time_s=self.time_s[rows],
            landmarks_px=self.landmarks_px[rows],
            landmarks_3d_m=self.landmarks_3d_m[rows],
            confidence=self.confidence[rows],
            confidence_3d=self.confidence_3d[rows],
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
class EnergyParameters:
    """Standard deviations of the terms, what robust ones are cut off at (in deviations), and which shared numbers move.

    `landmark_std_m`, `hand_std_m` and `contour_std_m` are metres at the person, `landmark_3d_std_m` is on the
    detector's 3D landmarks,
    `motion` a factor on `Objective.motion`, `log_focal_std` of the focal length's logarithm, `principal_point_std` in
    focal lengths.
    """

    landmark_std_m: float = 0.025
    hand_std_m: float = 0.060
    landmark_cutoff: float = 3.0
    landmark_3d_std_m: float = 0.08
    contour_std_m: float = 0.010
    contour_cutoff: float = 4.0
    motion: float = 1.0
    motion_cutoff: float = 4.0
    landmark_offset_std_m: float = 0.012
    height_m: float = 1.70
    height_std_m: float = 0.02
    log_focal_std: float = 0.5
    principal_point_std: float = 0.05
    free_shape: bool = True
    free_landmark_offsets: bool = False
    free_focal: bool = False
    free_principal_point: bool = False

    def landmark_stds_m(self) -> Float[Tensor, "l"]:
        """Standard deviation of each landmark in the image, metres at the person."""
        std = self.landmark_std_m * landmark_std_ratio()
        std[POSE_LANDMARK_COUNT:] = self.hand_std_m
        return std

    def has_free_shared_parameters(self) -> bool:
        """Whether any number that all frames share may move."""
        return self.free_shape or self.free_landmark_offsets or self.free_focal or self.free_principal_point


@dataclass(frozen=True)
class Objective:
    """All terms at hand; call it with a state.

    `px_per_m` is the image scale at each frame's person, held fixed while the state moves. `motion` are standard
    deviations of `motion_residuals`; None: `default_motion_std`, which fast people need. `contact` needs all that is
    shared to be fixed.
    """

    model: LinearBody
    regressor: LandmarkRegressor
    pose_prior: PosePrior
    shape_prior: ShapePrior
    observations: Observations
    weights: EnergyParameters
    px_per_m: Float[Tensor, "n"]
    contour: Contour | None = None
    motion: Float[Tensor, "p"] | None = None
    contact: Contact | None = None

    def __call__(self, state: FitState) -> NormalEquations:
        """The normal equations of all terms at a state."""
        model = self.model.moved(state.shape)
        frames, joints = state.rotations.shape[:2]
        shapes = len(state.shape)
        shared = shapes + LANDMARK_OFFSET_COUNT + INTRINSICS_COUNT if self.weights.has_free_shared_parameters() else 0
        system = NormalEquations.zeros(frames, 3 * joints + 3, shared)
        skeleton = pose_skeleton(model, state.rotations, state.root_m)
        self._add_landmarks(system, model, skeleton, state)
        if self.contour is not None:
            self._add_contour(system, model, skeleton, state, self.contour)
        if self.contact is not None:
            add_contact_term(system, model, skeleton, state.root_m, self.observations.camera, self.contact)
        self._add_pose_prior(system, state)
        self._add_motion_prior(system, state)
        if shared:
            self._add_shared_priors(system, model, state)
            system.fix_parameters(self._free_shared_mask(shapes))
        return system

    def retract(self, state: FitState, frame_step: Tensor, shared_step: Tensor) -> FitState:
        """The state after a step, its shape inside the allowed range."""
        moved = state.moved(frame_step, shared_step, self.observations.camera)
        return replace(moved, shape=moved.shape.clamp(self.shape_prior.lower_bound, self.shape_prior.upper_bound))

    def _free_shared_mask(self, shapes: int) -> Bool[Tensor, "g"]:
        free = torch.ones(shapes + LANDMARK_OFFSET_COUNT + INTRINSICS_COUNT, dtype=torch.bool)
        free[:shapes], free[shapes:-INTRINSICS_COUNT] = self.weights.free_shape, self.weights.free_landmark_offsets
        free[-INTRINSICS_COUNT:-1], free[-1] = self.weights.free_principal_point, self.weights.free_focal
        return free

    def _add_landmarks(
        self, system: NormalEquations, model: LinearBody, skeleton: PosedSkeleton, state: FitState
    ) -> None:
        observations, weights = self.observations, self.weights
        points = self.regressor.points(model, state.landmark_offsets_m)
        world, lever_arms = pose_points(model, skeleton, points)
        pixels, pixel_jacobian = project_with_jacobian(
            world, apply_intrinsics_delta(observations.camera, state.intrinsics_delta)
        )
        intrinsics_jacobian = compute_intrinsics_jacobian(pixels, observations.camera, state.intrinsics_delta)
        noise = landmark_std_ratio()
        facing = face_landmark_confidence(skeleton, observations.camera)
        confidence = observations.confidence * facing
        inverse = confidence.sqrt() / (weights.landmark_stds_m() * self.px_per_m[:, None])
        residual = (pixels - observations.landmarks_px) * inverse[..., None]
        weight = robust_weights(system, residual.square().sum(-1), weights.landmark_cutoff)
        perspective_jacobian = root_jacobian(state.root_m, observations.camera)
        for axis in range(2):
            point_gradient = pixel_jacobian[:, :, axis] * inverse[..., None]
            shared_jacobian = self._shared_jacobian(
                model, skeleton, points, point_gradient, intrinsics_jacobian[:, :, axis] * inverse[..., None]
            )
            system.add(
                pose_jacobian_rows(skeleton, lever_arms, perspective_jacobian, point_gradient),
                shared_jacobian,
                residual[..., axis],
                weight,
            )
        trust = observations.confidence_3d * facing / noise.square()
        self._add_3d_landmarks(system, model, skeleton, points, world, lever_arms, trust)

    def _add_3d_landmarks(
        self,
        system: NormalEquations,
        model: LinearBody,
        skeleton: PosedSkeleton,
        points: SkinnedPoints,
        world: Float[Tensor, "n l 3"],
        lever_arms: Float[Tensor, "n l j 3"],
        confidence: Float[Tensor, "n l"],
    ) -> None:
        """The detector's 3D landmarks, relative to the hips, in camera axes and of unknown scale."""
        observations, cutoff = self.observations, self.weights.landmark_cutoff
        to_camera = torch.as_tensor(observations.camera.world_to_camera, dtype=world.dtype)[:3, :3]
        relative, found = (world - _hip_midpoint(world)) @ to_camera.T, observations.landmarks_3d_m @ to_camera.T
        std = self.weights.landmark_3d_std_m * world.new_tensor([1.0, 1.0, DEPTH_STD_RATIO])
        inverse = confidence.sqrt()[..., None] / std
        scale = fit_3d_landmark_scale(relative, found, inverse, cutoff)
        residual = (scale * relative - found) * inverse
        weight = robust_weights(system, residual.square().sum(-1), cutoff)
        perspective_jacobian = torch.zeros(len(world), 3, 3, dtype=torch.float64)  # hips and landmarks move together
        for axis in range(3):
            point_gradient = (scale[axis] * to_camera[axis]).expand_as(world)
            rows = pose_jacobian_rows(skeleton, lever_arms, perspective_jacobian, point_gradient)
            shared = self._shared_jacobian(
                model, skeleton, points, point_gradient, world.new_zeros(*world.shape[:2], INTRINSICS_COUNT)
            )
            rows = (rows - _hip_midpoint(rows)) * inverse[..., axis, None]
            shared = (shared - _hip_midpoint(shared)) * inverse[..., axis, None]
            system.add(rows, shared, residual[..., axis], weight)

    def _add_contour(
        self, system: NormalEquations, model: LinearBody, skeleton: PosedSkeleton, state: FitState, contour: Contour
    ) -> None:
        observations = self.observations
        points = surface_points(model, contour.corners, contour.barycentric)
        world, lever_arms = pose_points(model, skeleton, points)
        pixels, pixel_jacobian = project_with_jacobian(
            world, apply_intrinsics_delta(observations.camera, state.intrinsics_delta)
        )
        inverse = 1.0 / (self.px_per_m[:, None] * self.weights.contour_std_m)
        residual = ((pixels - contour.target_px) * contour.normal).sum(-1) * inverse
        weight = contour.weight * robust_weights(system, residual.square(), self.weights.contour_cutoff, contour.weight)
        normal, inverse = contour.normal[..., None], inverse[..., None]
        point_gradient = (pixel_jacobian * normal).sum(2) * inverse
        intrinsics_jacobian = (
            compute_intrinsics_jacobian(pixels, observations.camera, state.intrinsics_delta) * normal
        ).sum(2) * inverse
        shared_jacobian = self._shared_jacobian(model, skeleton, points, point_gradient, intrinsics_jacobian)
        perspective_jacobian = root_jacobian(state.root_m, observations.camera)
        system.add(
            pose_jacobian_rows(skeleton, lever_arms, perspective_jacobian, point_gradient),
            shared_jacobian,
            residual,
            weight,
        )

    def _shared_jacobian(
        self,
        model: LinearBody,
        skeleton: PosedSkeleton,
        points: SkinnedPoints,
        point_gradient: Float[Tensor, "n m 3"],
        intrinsics_jacobian: Float[Tensor, "n m 3"],
    ) -> Float[Tensor, "n m g"]:
        """Derivative of covector · point by shape, landmark offsets and lens; no columns when all are fixed."""
        if not self.weights.has_free_shared_parameters():
            return point_gradient[..., :0]
        shape_jacobian = shape_jacobian_rows(model, skeleton, points, point_gradient)
        missing = len(model.shape) + LANDMARK_OFFSET_COUNT - shape_jacobian.shape[-1]
        offsets = shape_jacobian.new_zeros(*shape_jacobian.shape[:2], missing)
        return torch.cat([shape_jacobian, offsets, intrinsics_jacobian], dim=-1)

    def _add_pose_prior(self, system: NormalEquations, state: FitState) -> None:
        residual, derivative = pose_residuals(self.pose_prior, state.rotations)
        system.cost += float(residual.square().sum())
        gradient = (derivative.transpose(-1, -2) @ residual[..., None]).squeeze(-1)
        system.frame_gradient[:, :-3] += gradient.flatten(1)
        blocks = derivative.transpose(-1, -2) @ derivative
        for joint in range(blocks.shape[1]):
            span = slice(3 * joint, 3 * joint + 3)
            system.frame[:, span, span] += blocks[:, joint]

    def _add_motion_prior(self, system: NormalEquations, state: FitState) -> None:
        if len(state.root_m) < 3:
            return
        weights, time_s = self.weights, self.observations.time_s
        residual = motion_residuals(
            state.rotations, world_to_perspective(state.root_m, self.observations.camera), time_s
        )
        std = default_motion_std(state.rotations.shape[1]) if self.motion is None else self.motion
        residual = residual / (weights.motion * std)
        weight = robust_weights(system, residual.square(), weights.motion_cutoff)
        before, after, scale = (factor[:, None] for factor in acceleration_factors(time_s))
        factors = (before * scale / std, -(before + after) * scale / std, after * scale / std)
        diagonal = torch.diagonal(system.frame, dim1=1, dim2=2)
        inner = len(residual)
        for shift, factor in enumerate(factors):
            diagonal[shift : shift + inner] += weight * factor**2
            system.frame_gradient[shift : shift + inner] += weight * factor * residual
        system.next_frame_coupling[:inner] += weight * factors[0] * factors[1]
        system.next_frame_coupling[1 : inner + 1] += weight * factors[1] * factors[2]
        system.second_next_frame_coupling[:inner] += weight * factors[0] * factors[2]

    def _add_shared_priors(self, system: NormalEquations, model: LinearBody, state: FitState) -> None:
        """Priors on shape, stature, landmark offsets and lens."""
        weights, shapes = self.weights, len(state.shape)
        std = torch.cat(
            [
                self.shape_prior.std,
                torch.full((LANDMARK_OFFSET_COUNT,), weights.landmark_offset_std_m, dtype=torch.float64),
                torch.tensor(
                    [weights.principal_point_std, weights.principal_point_std, weights.log_focal_std],
                    dtype=torch.float64,
                ),
            ]
        )
        value = torch.cat([state.shape - self.shape_prior.mean, state.landmark_offsets_m, state.intrinsics_delta]) / std
        system.cost += float(value.square().sum())
        system.shared += torch.diag(std**-2)
        system.shared_gradient += value / std
        height_m, gradient = model.height_m()
        gradient = gradient / weights.height_std_m
        residual = (height_m - weights.height_m) / weights.height_std_m
        system.cost += residual**2
        system.shared[:shapes, :shapes] += torch.outer(gradient, gradient)
        system.shared_gradient[:shapes] += gradient * residual


def face_landmark_confidence(skeleton: PosedSkeleton, camera: Camera) -> Float[Tensor, "n l"]:
    """Trust in each landmark by where the head looks: a face found on the back of a head is the detector's guess."""
    head = ACTIVE_JOINTS.index("Head")
    to_camera = torch.nn.functional.normalize(
        torch.as_tensor(camera.centre_m(), dtype=torch.float64) - skeleton.position[:, head], dim=-1
    )
    cosine = (skeleton.rotation[:, head, :, 2] * to_camera).sum(-1)
    factor = torch.ones(len(cosine), LANDMARK_COUNT, dtype=torch.float64)
    factor[:, :FACE_LANDMARK_COUNT] = (0.5 + 2.0 * cosine).clamp(0.05, 1.0)[:, None]
    return factor


def fit_3d_landmark_scale(
    relative_m: Float[Tensor, "n l 3"],
    landmarks_3d_m: Float[Tensor, "n l 3"],
    inverse: Float[Tensor, "n l 3"],
    cutoff: float,
) -> Float[Tensor, "3"]:
    """Factors (across, across, depth; camera axes) that carry the body's 3D landmarks onto the detector's with the
    least robust cost. The detector makes people flatter than they are, so depth has a factor of its own.

    Being the best factors, their own change costs nothing to first order, so the derivatives take them as constant.
    """
    weight, scale = inverse.square(), relative_m.new_ones(3)
    for _ in range(SCALE_ITERATIONS):
        above, below = ((weight * relative_m * other).sum((0, 1)) for other in (landmarks_3d_m, relative_m))
        across = above[:2].sum() / below[:2].sum()
        depth = (above[2] / below[2]).clamp(MIN_DEPTH_SCALE_RATIO * across, MAX_DEPTH_SCALE_RATIO * across)
        scale = torch.stack([across, across, depth])
        squared = ((scale * relative_m - landmarks_3d_m) * inverse).square().sum(-1)
        weight = inverse.square() * ((1.0 + squared / cutoff**2) ** -2)[..., None]
    return scale


def compute_px_per_m(state: FitState, camera: Camera) -> Float[Tensor, "n"]:
    """Pixels a metre at each frame's person."""
    return apply_intrinsics_delta(camera, state.intrinsics_delta).fx * torch.exp(
        -world_to_perspective(state.root_m, camera)[:, 2]
    )


def _hip_midpoint(values: Float[Tensor, "n l c"]) -> Float[Tensor, "n 1 c"]:
    return 0.5 * (values[:, LEFT_HIP] + values[:, RIGHT_HIP])[:, None]
