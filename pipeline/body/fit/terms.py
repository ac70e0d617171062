"""Energy terms of the fit. Each adds its Gauss-Newton approximation to the normal equations.

Residuals are divided by their standard deviations. Distances in the image are measured in metres at the depth of the
person, so that the weights hold for any resolution. Robust terms use the Geman-McClure function
rho(r) = r^2 / (1 + r^2 / c^2) (Barron, "A general and adaptive robust loss function", 2019); c is the cutoff.

Dimensions: n frames, l landmarks, m points of a frame, g shared parameters.
"""

from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.body.fit.camera_parameters import (
    apply_intrinsics_delta,
    compute_intrinsics_jacobian,
    project_with_jacobian,
)
from pipeline.body.fit.ground_contact import CONTACT_CUTOFF, CONTACT_STD_M, Contact
from pipeline.body.fit.landmark_regressor import (
    LANDMARK_COUNT,
    LANDMARK_OFFSET_COUNT,
    landmark_offset_std_ratio,
)
from pipeline.body.fit.levenberg_marquardt import NormalEquations, robust_weights
from pipeline.body.fit.linear_body import ACTIVE_JOINTS, LinearBody
from pipeline.body.fit.posed_points import (
    Contour,
    PosedPoints,
    PosedSkeleton,
    pose_jacobian_rows,
    pose_points,
    shape_jacobian_rows,
    surface_points,
)
from pipeline.body.fit.prior.priors import (
    FOOT_LENGTH_RATIO,
    FOOT_LENGTH_RATIO_STD,
    PosePrior,
    ShapePrior,
    acceleration_factors,
    default_motion_std,
    motion_residuals,
    pose_residuals,
    tilt_of_hips,
)
from pipeline.body.fit.root_placement import root_jacobian, world_to_perspective
from pipeline.body.fit.state import FitState, Observations
from pipeline.geometry.camera import Camera

FACE_LANDMARK_COUNT = 11


@dataclass(frozen=True)
class Linearisation:
    """A state and what several terms derive from it.

    model: the linear body at the shape of the state.
    landmarks: the landmarks on the posed body.
    has_shared: whether the normal equations have shared parameters.
    """

    state: FitState
    camera: Camera
    model: LinearBody
    skeleton: PosedSkeleton
    landmarks: PosedPoints
    has_shared: bool

    def select(self, rows: slice) -> "Linearisation":
        """Return the same for some frames."""
        return replace(
            self,
            state=self.state.select(rows),
            skeleton=self.skeleton.select(rows),
            landmarks=self.landmarks.select(rows),
        )

    def projection(
        self, points: PosedPoints
    ) -> tuple[Float[Tensor, "n m 2"], Float[Tensor, "n m 2 3"], Float[Tensor, "n m 2 3"]]:
        """Return pixels and their derivatives with respect to the world point (m) and the intrinsics delta."""
        delta = self.state.intrinsics_delta
        pixels, pixel_jacobian = project_with_jacobian(points.world_m, apply_intrinsics_delta(self.camera, delta))
        return pixels, pixel_jacobian, compute_intrinsics_jacobian(pixels, self.camera, delta)

    def pose_jacobian(
        self, points: PosedPoints, root_jacobian: Float[Tensor, "n 3 3"], point_gradient: Float[Tensor, "n m 3"]
    ) -> Float[Tensor, "n m p"]:
        """Return the derivative of point_gradient · point with respect to the pose parameters."""
        return pose_jacobian_rows(self.skeleton, points.lever_arms_m, root_jacobian, point_gradient)

    def shared_jacobian(
        self,
        points: PosedPoints,
        point_gradient: Float[Tensor, "n m 3"],
        intrinsics_jacobian: Float[Tensor, "n m 3"],
    ) -> Float[Tensor, "n m g"]:
        """Return the derivative of point_gradient · point with respect to shape, landmark offsets and intrinsics.

        It has no columns if there are no shared parameters.
        """
        if not self.has_shared:
            return point_gradient[..., :0].float()
        shape_jacobian = shape_jacobian_rows(self.model, self.skeleton, points.rest, point_gradient)
        missing = len(self.model.shape) + LANDMARK_OFFSET_COUNT - shape_jacobian.shape[-1]
        offsets = shape_jacobian.new_zeros(*shape_jacobian.shape[:2], missing)
        return torch.cat([shape_jacobian, offsets, intrinsics_jacobian.float()], dim=-1)


@runtime_checkable
class EnergyTerm(Protocol):
    """A part of the energy."""

    def add_to(self, system: NormalEquations, at: Linearisation) -> None:
        """Add cost, gradient and Gauss-Newton Hessian at a state."""
        ...


@dataclass(frozen=True)
class LandmarkTerm:
    """Reprojection errors of the landmarks, robust.

    std_m: standard deviation of each landmark, metres at the depth of the person.
    px_per_m: image scale at the person in each frame, constant during a minimisation.
    """

    observations: Observations
    std_m: Float[Tensor, "l"]
    px_per_m: Float[Tensor, "n"]
    cutoff: float

    def add_to(self, system: NormalEquations, at: Linearisation) -> None:
        """Add cost, gradient and Gauss-Newton Hessian at a state."""
        pixels, pixel_jacobian, intrinsics_jacobian = at.projection(at.landmarks)
        confidence = self.observations.confidence * face_landmark_confidence(at.skeleton, at.camera)
        inverse_std = confidence.sqrt() / (self.std_m * self.px_per_m[:, None])
        residual = (pixels - self.observations.landmarks_px) * inverse_std[..., None]
        weight = robust_weights(system, residual.square().sum(-1), self.cutoff)
        perspective_jacobian = root_jacobian(at.state.root_m, at.camera)
        for axis in range(2):
            point_gradient = pixel_jacobian[:, :, axis] * inverse_std[..., None]
            system.accumulate(
                at.pose_jacobian(at.landmarks, perspective_jacobian, point_gradient),
                at.shared_jacobian(
                    at.landmarks, point_gradient, intrinsics_jacobian[:, :, axis] * inverse_std[..., None]
                ),
                residual[..., axis],
                weight,
            )


@dataclass(frozen=True)
class SilhouetteTerm:
    """Distances of silhouette points from the mask outline, robust.

    std_m: standard deviation, metres at the depth of the person. px_per_m: as in `LandmarkTerm`.
    """

    contour: Contour
    std_m: float
    px_per_m: Float[Tensor, "n"]
    cutoff: float

    def add_to(self, system: NormalEquations, at: Linearisation) -> None:
        """Add cost, gradient and Gauss-Newton Hessian at a state."""
        contour = self.contour
        points = pose_points(at.model, at.skeleton, surface_points(at.model, contour.corners, contour.barycentric))
        pixels, pixel_jacobian, intrinsics_jacobian = at.projection(points)
        inverse_std = 1.0 / (self.px_per_m[:, None] * self.std_m)
        residual = ((pixels - contour.target_px) * contour.normal).sum(-1) * inverse_std
        weight = contour.weight * robust_weights(system, residual.square(), self.cutoff, contour.weight)
        normal, inverse_std = contour.normal[..., None], inverse_std[..., None]
        point_gradient = (pixel_jacobian * normal).sum(2) * inverse_std
        shared = at.shared_jacobian(points, point_gradient, (intrinsics_jacobian * normal).sum(2) * inverse_std)
        rows = at.pose_jacobian(points, root_jacobian(at.state.root_m, at.camera), point_gradient)
        system.accumulate(rows, shared, residual, weight)


@dataclass(frozen=True)
class ContactTerm:
    """Distances of standing soles from the floor and from where they stand, robust. Needs fixed shared parameters."""

    contact: Contact

    def add_to(self, system: NormalEquations, at: Linearisation) -> None:
        """Add cost, gradient and Gauss-Newton Hessian at a state."""
        contact = self.contact
        points = pose_points(at.model, at.skeleton, contact.points)
        perspective_jacobian = root_jacobian(at.state.root_m, at.camera)
        residual = (points.world_m @ contact.axes.T - contact.target_m) / CONTACT_STD_M
        weight = contact.weight * robust_weights(system, residual.square(), CONTACT_CUTOFF, contact.weight)
        for axis, direction in enumerate(contact.axes):
            point_gradient = (direction / CONTACT_STD_M).expand_as(points.world_m)
            rows = at.pose_jacobian(points, perspective_jacobian, point_gradient)
            system.accumulate(rows, point_gradient[..., :0].float(), residual[..., axis], weight[..., axis])


@dataclass(frozen=True)
class PosePriorTerm:
    """Deviations of joint angles and of the tilt of the hips from the pose prior; excess over the joint limits."""

    prior: PosePrior

    def add_to(self, system: NormalEquations, at: Linearisation) -> None:
        """Add cost, gradient and Gauss-Newton Hessian at a state."""
        residual, jacobian = pose_residuals(self.prior, at.state.rotations)
        system.cost += float(residual.square().sum())
        gradient = (jacobian.transpose(-1, -2) @ residual[..., None]).squeeze(-1)
        system.frame_gradient[:, :-3] += gradient.flatten(1)
        blocks = jacobian.transpose(-1, -2) @ jacobian
        for joint in range(blocks.shape[1]):
            span = slice(3 * joint, 3 * joint + 3)
            system.frame_hessian[:, span, span] += blocks[:, joint]
        tilt, tilt_jacobian = tilt_of_hips(at.state.rotations[:, 0])
        tilt_residual = (tilt - self.prior.tilt_mean) / self.prior.tilt_std
        tilt_jacobian = tilt_jacobian / self.prior.tilt_std[:, None]
        system.cost += float(tilt_residual.square().sum())
        system.frame_gradient[:, :3] += (tilt_jacobian.transpose(-1, -2) @ tilt_residual[..., None]).squeeze(-1)
        system.frame_hessian[:, :3, :3] += tilt_jacobian.transpose(-1, -2) @ tilt_jacobian


@dataclass(frozen=True)
class MotionTerm:
    """Changes of velocity between successive frames, robust.

    std: standard deviations of `motion_residuals`; None: `default_motion_std`.
    """

    time_s: Float[Tensor, "n"]
    std: Float[Tensor, "p"] | None
    cutoff: float

    def add_to(self, system: NormalEquations, at: Linearisation) -> None:
        """Add cost, gradient and Gauss-Newton Hessian at a state; nothing if there are fewer than three frames."""
        state = at.state
        if len(state.root_m) < 3:
            return
        root_perspective = world_to_perspective(state.root_m, at.camera)
        residual = motion_residuals(state.rotations, root_perspective, self.time_s)
        std = default_motion_std(state.rotations.shape[1]) if self.std is None else self.std
        residual = residual / std
        weight = robust_weights(system, residual.square(), self.cutoff)
        before, after, scale = (factor[:, None] for factor in acceleration_factors(self.time_s))
        factors = (before * scale / std, -(before + after) * scale / std, after * scale / std)
        diagonal = torch.diagonal(system.frame_hessian, dim1=1, dim2=2)
        inner = len(residual)
        for shift, factor in enumerate(factors):
            diagonal[shift : shift + inner] += weight * factor**2
            system.frame_gradient[shift : shift + inner] += weight * factor * residual
        system.next_frame_coupling[:inner] += weight * factors[0] * factors[1]
        system.next_frame_coupling[1 : inner + 1] += weight * factors[1] * factors[2]
        system.second_next_frame_coupling[:inner] += weight * factors[0] * factors[2]


@dataclass(frozen=True)
class SharedPriorTerm:
    """Priors on shape, stature, length of the feet over the stature, landmark offsets and intrinsics.

    intrinsics_std: of the intrinsics delta (principal point in focal lengths, logarithm of the focal length).
    """

    shape_prior: ShapePrior
    landmark_offset_std_m: float
    intrinsics_std: tuple[float, float, float]
    height_m: float
    height_std_m: float

    def add_to(self, system: NormalEquations, at: Linearisation) -> None:
        """Add cost, gradient and Gauss-Newton Hessian at a state; nothing if there are no shared parameters."""
        if not at.has_shared:
            return
        state = at.state
        std = torch.cat(
            [
                self.shape_prior.std,
                self.landmark_offset_std_m * landmark_offset_std_ratio(),
                torch.tensor(self.intrinsics_std, dtype=torch.float64),
            ]
        )
        value = torch.cat([state.shape - self.shape_prior.mean, state.landmark_offsets_m, state.intrinsics_delta]) / std
        system.cost += float(value.square().sum())
        system.shared_hessian += torch.diag(std**-2)
        system.shared_gradient += value / std
        height_m, height_gradient = at.model.height_m()
        foot_m, foot_gradient = at.model.foot_length_m()
        ratio = foot_m / height_m
        ratio_gradient = (foot_gradient - ratio * height_gradient) / height_m
        _add_measure(system, (height_m - self.height_m) / self.height_std_m, height_gradient / self.height_std_m)
        _add_measure(
            system, (ratio - FOOT_LENGTH_RATIO) / FOOT_LENGTH_RATIO_STD, ratio_gradient / FOOT_LENGTH_RATIO_STD
        )


def _add_measure(system: NormalEquations, residual: float, gradient: Float[Tensor, "s"]) -> None:
    """Add the residual of a measure of the rest body and its derivative with respect to the shape."""
    shape = slice(len(gradient))
    system.cost += residual**2
    system.shared_hessian[shape, shape] += torch.outer(gradient, gradient)
    system.shared_gradient[shape] += gradient * residual


def face_landmark_confidence(skeleton: PosedSkeleton, camera: Camera) -> Float[Tensor, "n l"]:
    """Return factors in [0.05, 1] on the confidence of the landmarks: small for face landmarks seen from behind.

    The detector invents a face on the back of a head.
    """
    head = ACTIVE_JOINTS.index("Head")
    to_camera = torch.nn.functional.normalize(
        torch.as_tensor(camera.centre_m(), dtype=torch.float64) - skeleton.position_m[:, head], dim=-1
    )
    cosine = (skeleton.rotation[:, head, :, 2] * to_camera).sum(-1)
    factor = torch.ones(len(cosine), LANDMARK_COUNT, dtype=torch.float64)
    factor[:, :FACE_LANDMARK_COUNT] = (0.5 + 2.0 * cosine).clamp(0.05, 1.0)[:, None]
    return factor
