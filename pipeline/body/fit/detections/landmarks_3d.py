"""Energy term of the 3D landmarks of the detector, which are relative to the line of sight and flattened."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.body.fit.camera_parameters import INTRINSICS_COUNT
from pipeline.body.fit.initialisation import LEFT_HIP, RIGHT_HIP
from pipeline.body.fit.landmark_regressor import landmark_std_ratio
from pipeline.body.fit.levenberg_marquardt import NormalEquations, robust_weights
from pipeline.body.fit.root_placement import line_of_sight_rotation, world_to_perspective
from pipeline.body.fit.state import Observations
from pipeline.body.fit.terms import Linearisation, face_landmark_confidence

SCALE_ITERATIONS = 3
DEPTH_STD_RATIO = 2.0
"""Standard deviation of a detected landmark along the depth axis, relative to the one across."""
MIN_DEPTH_SCALE_RATIO, MAX_DEPTH_SCALE_RATIO = 0.4, 1.2
"""Range of the detector's depth scale, relative to its scale across."""


@dataclass(frozen=True)
class Landmark3dTerm:
    """Errors of the 3D landmarks relative to the middle of the hips, robust, in the axes of the line of sight.

    The detector sees a crop around the person and does not know where it lies in the image: a person who walks sideways
    through the picture seems to turn. Its landmarks are thus relative to the line of sight to the root.
    The scale of the detector is unknown and has its own factor along the depth axis (`fit_3d_landmark_scale`).
    std_m: standard deviation across the view; the one along the depth is `DEPTH_STD_RATIO` times larger.
    scale: of the detector in the whole recording, from `fitted_to`.
    """

    observations: Observations
    std_m: float
    cutoff: float
    scale: Float[Tensor, "3"]

    @classmethod
    def fitted_to(cls, observations: Observations, std_m: float, cutoff: float, at: Linearisation) -> "Landmark3dTerm":
        """Return the term with the scale of least cost at a state of all frames."""
        unit = cls(observations, std_m, cutoff, torch.ones(3, dtype=torch.float64))
        in_camera_m, to_sight, _ = unit._in_camera_axes(at)
        return replace(unit, scale=fit_3d_landmark_scale(in_camera_m @ to_sight.mT, *unit._detected(at), cutoff))

    def _in_camera_axes(
        self, at: Linearisation
    ) -> tuple[Float[Tensor, "n l 3"], Float[Tensor, "n 3 3"], Float[Tensor, "n 2 3 3"]]:
        """Return the landmarks of the body relative to the hips, and the rotation to the line of sight to the root."""
        world_m = at.landmarks.world_m
        to_camera = torch.as_tensor(at.camera.world_to_camera, dtype=world_m.dtype)[:3, :3]
        direction = world_to_perspective(at.state.root_m, at.camera)[:, :2]
        return (world_m - _hip_midpoint(world_m)) @ to_camera.T, *line_of_sight_rotation(direction)

    def _detected(self, at: Linearisation) -> tuple[Float[Tensor, "n l 3"], Float[Tensor, "n l 3"]]:
        """Return the detected landmarks in the axes of the line of sight, and inverse deviations."""
        detected_m = self.observations.landmarks_3d_m
        to_camera = torch.as_tensor(at.camera.world_to_camera, dtype=detected_m.dtype)[:3, :3]
        confidence = self.observations.confidence_3d * face_landmark_confidence(at.skeleton, at.camera)
        weight = (confidence / landmark_std_ratio().square()).sqrt()
        return detected_m @ to_camera.T, weight[..., None] / (
            self.std_m * detected_m.new_tensor([1.0, 1.0, DEPTH_STD_RATIO])
        )

    def add_to(self, system: NormalEquations, at: Linearisation) -> None:
        """Add cost, gradient and Gauss-Newton Hessian at a state."""
        world_m, scale = at.landmarks.world_m, self.scale
        to_camera = torch.as_tensor(at.camera.world_to_camera, dtype=world_m.dtype)[:3, :3]
        in_camera_m, to_sight, to_sight_jacobian = self._in_camera_axes(at)
        detected_m, inverse_std = self._detected(at)
        residual = (scale * (in_camera_m @ to_sight.mT) - detected_m) * inverse_std
        by_direction_m = in_camera_m[:, None] @ to_sight_jacobian.mT
        weight = robust_weights(system, residual.square().sum(-1), self.cutoff)
        no_root = torch.zeros(len(world_m), 3, 3, dtype=torch.float64)  # a root translation moves hips and landmarks
        no_intrinsics = world_m.new_zeros(*world_m.shape[:2], INTRINSICS_COUNT)
        for axis in range(3):
            point_gradient = (scale[axis] * to_sight[:, axis] @ to_camera)[:, None].expand_as(world_m)
            rows = at.pose_jacobian(at.landmarks, no_root, point_gradient)
            shared = at.shared_jacobian(at.landmarks, point_gradient, no_intrinsics)
            rows = rows - _hip_midpoint(rows)
            rows[..., -3:-1] += (scale[axis] * by_direction_m[..., axis]).transpose(1, 2).to(rows)
            system.accumulate(
                rows * inverse_std[..., axis, None].float(),
                (shared - _hip_midpoint(shared)) * inverse_std[..., axis, None].float(),
                residual[..., axis],
                weight,
            )


def fit_3d_landmark_scale(
    relative_m: Float[Tensor, "n l 3"],
    landmarks_3d_m: Float[Tensor, "n l 3"],
    inverse_std: Float[Tensor, "n l 3"],
    cutoff: float,
) -> Float[Tensor, "3"]:
    """Return the factors (x, y, depth) that map the landmarks of the body to the detected ones with least robust cost.

    x and y have the same factor; the depth has its own because the detector flattens people. The factors minimise the
    cost, so its derivative with respect to them is zero and the Jacobians may take them as constant.

    relative_m, landmarks_3d_m: relative to the middle of the hips, axes of the line of sight.
    """
    weight, scale = inverse_std.square(), relative_m.new_ones(3)
    for _ in range(SCALE_ITERATIONS):
        numerator, denominator = ((weight * relative_m * other).sum((0, 1)) for other in (landmarks_3d_m, relative_m))
        across = numerator[:2].sum() / denominator[:2].sum()
        depth = (numerator[2] / denominator[2]).clamp(MIN_DEPTH_SCALE_RATIO * across, MAX_DEPTH_SCALE_RATIO * across)
        scale = torch.stack([across, across, depth])
        squared = ((scale * relative_m - landmarks_3d_m) * inverse_std).square().sum(-1)
        weight = inverse_std.square() * ((1.0 + squared / cutoff**2) ** -2)[..., None]
    return scale


def _hip_midpoint(values: Float[Tensor, "n l c"]) -> Float[Tensor, "n 1 c"]:
    return 0.5 * (values[:, LEFT_HIP] + values[:, RIGHT_HIP])[:, None]
