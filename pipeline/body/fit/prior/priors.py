"""Priors on pose, motion and shape.

Residuals are in standard deviations. Angles are rotation vectors of the local rotation in the axes of each joint (rows
of `PosePrior.axes`): (twist about the bone, flexion, sideways) for hinges, x, y, z of the body for others.

Dimensions: n frames, j active joints, p = 3 j + 3 parameters of a frame, t = n - 2 inner frames, s shape parameters.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.body.body import SCALE
from pipeline.body.fit.linear_body import ACTIVE_JOINTS, LinearBody
from pipeline.body.fit.prior.joint_limits import JointLimits, hinge_axes, joint_limits, strip_side
from pipeline.geometry.rotation import matrix_to_quaternion, quaternion_to_axis_angle

REFERENCE_INTERVAL_S = 1.0 / 30.0
"""Frame interval to which the standard deviations of the motion prior refer."""

MOTION_STD_RAD, MOTION_ROOT_STD = 0.03, 0.003
"""Change of the velocity of joints (rad per frame) and root (perspective coordinates) between frames, for the fastest
people."""

MIN_MOTION_RATIO = 0.15
"""Lower bound of an estimated standard deviation, relative to the ones above."""

MOTION_LAG = 2
"""Larger of the two frame intervals whose comparison separates motion from noise."""

MOTION_STD_FACTOR = 2.0
"""Factor on the estimated standard deviation, because motion is not uniform over time."""

UNCONSTRAINED_RAD = 10.0

TILT_STD_RAD = 0.3
"""Standard deviation of the tilt of the hips about upright (docs/decisions/body.md)."""

BALL_JOINT_STD_RAD = {
    "Hips": (UNCONSTRAINED_RAD, UNCONSTRAINED_RAD, UNCONSTRAINED_RAD),
    "Spine": (0.15, 0.10, 0.10),
    "Spine1": (0.15, 0.10, 0.10),
    "Spine2": (0.15, 0.10, 0.10),
    "Neck": (0.20, 0.375, 0.15),
    "Head": (0.375, 0.525, 0.15),
    "Shoulder": (0.12, 0.12, 0.12),
    "Arm": (1.05, 1.05, 1.05),
    "Hand": (0.375, 0.375, 0.375),
    "UpLeg": (0.9, 0.45, 0.45),
    "Foot": (0.375, 0.15, 0.15),
    "ToeBase": (0.12, 0.04, 0.04),
}
"""Standard deviations about x, y, z of the body, relative to the A-pose."""
HINGE_JOINT_STD_RAD = {"ForeArm": (0.75, 1.05, 0.05), "Leg": (0.12, 1.05, 0.05)}
"""Standard deviations of twist, flexion, sideways."""

PHENOTYPE_STD = {
    "gender": 0.35,
    "age": 0.08,
    "muscle": 0.25,
    "weight": 0.25,
    "height": 0.35,
    "proportions": 0.3,
    "cupsize": 0.2,
    "firmness": 0.1,
    "african": 0.15,
    "asian": 0.15,
    "caucasian": 0.15,
}
LOCAL_CHANGE_STD = 0.3
"""Standard deviation of shape parameters that are no phenotypes: local changes about 0."""

FOOT_LENGTH_RATIO, FOOT_LENGTH_RATIO_STD = 0.158, 0.006
"""Mean and standard deviation of a foot's length over the stature: 0.15 without shoes, which add 1 to 2 cm (Fessler,
Haley and Lal, "Sexual dimorphism in foot length proportionate to stature", 2005). Frontal views hardly tell it."""

BETA_STD = 1.0
"""Standard deviation of SMPL betas, which are principal components scaled to unit variance."""

BETA_RANGE = (-5.0, 5.0)
PHENOTYPE_RANGE = (0.02, 0.98)
LOCAL_CHANGE_RANGE = (-1.0, 1.0)
SCALE_STD = 0.1
SCALE_RANGE = (0.6, 1.4)


@dataclass(frozen=True)
class ShapePrior:
    """Mean, standard deviation and range of the shape parameters."""

    mean: Float[Tensor, "s"]
    std: Float[Tensor, "s"]
    lower_bound: Float[Tensor, "s"]
    upper_bound: Float[Tensor, "s"]


def shape_prior(names: Sequence[str], defaults: Float[Tensor, "s"]) -> ShapePrior:
    """Return the prior of a body's shape parameters by their names; unknown names count as local changes."""
    known = {name: (std, *PHENOTYPE_RANGE) for name, std in PHENOTYPE_STD.items()}
    known[SCALE] = (SCALE_STD, *SCALE_RANGE)
    known.update({name: (BETA_STD, *BETA_RANGE) for name in names if name.startswith("beta_")})
    rows = [known.get(name, (LOCAL_CHANGE_STD, *LOCAL_CHANGE_RANGE)) for name in names]
    return ShapePrior(defaults.double(), *torch.tensor(rows, dtype=torch.float64).unbind(1))


@dataclass(frozen=True)
class PosePrior:
    """Axes (rows), mean angles with standard deviations, and limits of every active joint; tilt of the hips.

    tilt_mean, tilt_std: of `tilt_of_hips`.
    """

    axes: Float[Tensor, "j 3 3"]
    mean_rad: Float[Tensor, "j 3"]
    std_rad: Float[Tensor, "j 3"]
    limits: JointLimits
    tilt_mean: Float[Tensor, "2"]
    tilt_std: Float[Tensor, "2"]


def pose_prior(model: LinearBody) -> PosePrior:
    """Return the prior of a body; hinge axes and limits depend on its rest pose."""
    axes = torch.eye(3, dtype=torch.float64).repeat(len(ACTIVE_JOINTS), 1, 1)
    std = torch.zeros(len(ACTIVE_JOINTS), 3, dtype=torch.float64)
    for joint, joint_type in enumerate(map(strip_side, ACTIVE_JOINTS)):
        if joint_type in HINGE_JOINT_STD_RAD:
            axes[joint], _ = hinge_axes(model, joint)
        std[joint] = torch.tensor({**BALL_JOINT_STD_RAD, **HINGE_JOINT_STD_RAD}[joint_type], dtype=torch.float64)
    no_tilt = torch.zeros(2, dtype=torch.float64)
    return PosePrior(axes, torch.zeros_like(std), std, joint_limits(model), no_tilt, no_tilt + TILT_STD_RAD)


def tilt_of_hips(rotation: Float[Tensor, "n 3 3"]) -> tuple[Float[Tensor, "n 2"], Float[Tensor, "n 2 3"]]:
    """Return where +Y of the world points in the axes of the hips, and its derivative by the rotation.

    The components are (to the person's left, to the front): about the angle, in rad, by which the hips tilt to the
    right and backwards, whatever way they face.
    """
    up = rotation.new_tensor([0.0, 1.0, 0.0])
    in_hips = rotation.transpose(-1, -2)
    return (in_hips @ up)[:, ::2], (in_hips @ skew_symmetric(up))[:, ::2]


def rotation_to_axis_angle(rotation: Float[Tensor, "*n 3 3"]) -> Float[Tensor, "*n 3"]:
    """Return the rotation vector (rad) of a rotation matrix."""
    return quaternion_to_axis_angle(matrix_to_quaternion(rotation))


def skew_symmetric(vector: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3 3"]:
    """Return [v]x, so that [v]x u = v x u."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    rows = [torch.stack([zero, -z, y], -1), torch.stack([z, zero, -x], -1), torch.stack([-y, x, zero], -1)]
    return torch.stack(rows, dim=-2)


def inverse_left_jacobian_so3(vector: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3 3"]:
    """Return the inverse left Jacobian of SO(3): the derivative of log(exp(delta) exp(vector)) by delta at 0."""
    angle = vector.norm(dim=-1)[..., None, None].clamp(min=1e-4, max=3.1)
    bracket = skew_symmetric(vector)
    curve = 1.0 / angle**2 - (1.0 + torch.cos(angle)) / (2.0 * angle * torch.sin(angle))
    return torch.eye(3, dtype=vector.dtype) - 0.5 * bracket + curve * (bracket @ bracket)


def pose_residuals(
    prior: PosePrior, rotations: Float[Tensor, "n j 3 3"]
) -> tuple[Float[Tensor, "n j 6"], Float[Tensor, "n j 6 3"]]:
    """Return deviations from the mean pose and excess over joint limits, and their derivative by the rotation."""
    vector = rotation_to_axis_angle(rotations)
    angle = (prior.axes @ vector[..., None]).squeeze(-1)
    rotation_jacobian = prior.axes @ inverse_left_jacobian_so3(vector)
    excess, excess_rotation_jacobian = prior.limits.residuals(rotations)
    residual = torch.cat([(angle - prior.mean_rad) / prior.std_rad, excess], dim=-1)
    return residual, torch.cat([rotation_jacobian / prior.std_rad[..., None], excess_rotation_jacobian], dim=-2)


def acceleration_factors(
    time_s: Float[Tensor, "n"],
) -> tuple[Float[Tensor, "t"], Float[Tensor, "t"], Float[Tensor, "t"]]:
    """Return for each inner frame the factors on the step before it, on the step after it, and on the residual.

    Velocities use the actual frame intervals. The change of velocity grows with the square root of the interval (white
    noise acceleration), so that dropped frames loosen the coupling.
    """
    interval = torch.diff(time_s).clamp(min=1e-4) / REFERENCE_INTERVAL_S
    before, after = 1.0 / interval[:-1], 1.0 / interval[1:]
    return before, after, 1.0 / (0.5 * (interval[:-1] + interval[1:])).sqrt()


def motion_residuals(
    rotations: Float[Tensor, "n j 3 3"], root_perspective: Float[Tensor, "n 3"], time_s: Float[Tensor, "n"]
) -> Float[Tensor, "t p"]:
    """Return the change of velocity at each inner frame: joint rotations (rad per frame), then perspective coordinates.

    To first order its derivative by the rotation steps of frames t - 1, t, t + 1 is (before, -before - after, after).
    """
    steps = rotation_to_axis_angle(rotations[1:] @ rotations[:-1].transpose(-1, -2)).flatten(1)
    steps = torch.cat([steps, torch.diff(root_perspective, dim=0)], dim=1)
    before, after, scale = acceleration_factors(time_s)
    return (steps[1:] * after[:, None] - steps[:-1] * before[:, None]) * scale[:, None]


def default_motion_std(joints: int) -> Float[Tensor, "p"]:
    """Return the standard deviations of `motion_residuals` for an unknown motion."""
    std = torch.full((3 * joints + 3,), MOTION_STD_RAD, dtype=torch.float64)
    std[-3:] = MOTION_ROOT_STD
    return std


def estimate_motion_std(
    rotations: Float[Tensor, "n j 3 3"], root_perspective: Float[Tensor, "n 3"], time_s: Float[Tensor, "n"]
) -> Float[Tensor, "p"]:
    """Return the standard deviations of `motion_residuals`, one for each joint, estimated from the fitted poses.

    Errors that change between frames resemble motion but do not accumulate. At k times the interval, the squared
    residual of white noise acceleration of variance s^2 with white noise is s^2 + noise / k^3; k = 1 and
    k = `MOTION_LAG` give s^2.
    The result is `MOTION_STD_FACTOR` times s, clamped to [`MIN_MOTION_RATIO`, 1] times `default_motion_std`.
    """
    default_std = default_motion_std(rotations.shape[1])
    if len(time_s) < 4 * MOTION_LAG:
        return default_std
    near = motion_residuals(rotations, root_perspective, time_s).square().mean(0)
    spans = [slice(start, None, MOTION_LAG) for start in range(MOTION_LAG)]
    far = (
        torch.cat([motion_residuals(rotations[span], root_perspective[span], time_s[span]) for span in spans])
        .square()
        .mean(0)
    )
    variance = (MOTION_LAG**3 * far - near) / (MOTION_LAG**3 - 1)
    variance = variance.reshape(-1, 3).mean(1).clamp(min=0.0).repeat_interleave(3)
    return torch.minimum(
        torch.maximum(MOTION_STD_FACTOR * variance.sqrt(), MIN_MOTION_RATIO * default_std), default_std
    )
