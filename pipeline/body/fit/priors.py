"""What is known before any picture: how joints bend, how people move, how tall and how shaped they are.

Residuals are in standard deviations. Angles are rotation vectors of the local rotation, resolved along each joint's own
axes (rows of `PosePrior.axes`): for hinges (twist along the bone, flexion, sideways), else the body's x, y, z.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.body.body import SCALE
from pipeline.body.fit.joint_limits import JointLimits, hinge_axes, joint_limits, strip_side
from pipeline.body.fit.linear_body import ACTIVE_JOINTS, LinearBody
from pipeline.geometry.rotation import matrix_to_quaternion, quaternion_to_axis_angle

REFERENCE_INTERVAL_S = 1.0 / 30.0
"""Interval that the motion prior's deviations are given for."""

MOTION_STD_RAD, MOTION_ROOT_STD = 0.03, 0.003
"""How much joints turn faster and the root moves faster (`fit_place`) from frame to frame, for the fastest people."""

MIN_MOTION_RATIO = 0.15
"""The calmest that a joint is believed to be, as a share of that."""

MOTION_LAG = 2
"""Frames over which a motion is told from noise."""

MOTION_STD_FACTOR = 2.0
"""People do not move evenly: more is allowed than was seen."""

UNCONSTRAINED_RAD = 10.0

LOOSE_STD_RAD, STATIC_SPREAD_RAD = 0.25, 0.25
"""Axes with at least this deviation, whose angles in a recording spread less than that, follow its mean pose."""

MIN_SPREAD_RAD, SPREAD_FACTOR = 0.02, 3.0
"""The least that any joint moves, and how much more than the spread seen is allowed."""

# (deviation about the three axes, rad), symmetric about the A-pose
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
# (deviation of twist, flexion, sideways)
HINGE_JOINT_STD_RAD = {"ForeArm": (0.75, 1.05, 0.05), "Leg": (0.12, 1.05, 0.05)}

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
"""For shape numbers that are no phenotypes: local changes about 0."""

BETA_STD = 1.0
"""For the betas of SMPL, which are principal components scaled to unit variance."""

BETA_RANGE = (-5.0, 5.0)
PHENOTYPE_RANGE = (0.02, 0.98)
LOCAL_CHANGE_RANGE = (-1.0, 1.0)
SCALE_STD = 0.1
SCALE_RANGE = (0.6, 1.4)


@dataclass(frozen=True)
class ShapePrior:
    """Expected shape, its standard deviation and its allowed range."""

    mean: Float[Tensor, "s"]
    std: Float[Tensor, "s"]
    lower_bound: Float[Tensor, "s"]
    upper_bound: Float[Tensor, "s"]


def shape_prior(names: Sequence[str], defaults: Float[Tensor, "s"]) -> ShapePrior:
    """The prior for a body's shape numbers, by their names; unknown names count as local changes."""
    known = {name: (std, *PHENOTYPE_RANGE) for name, std in PHENOTYPE_STD.items()}
    known[SCALE] = (SCALE_STD, *SCALE_RANGE)
    known.update({name: (BETA_STD, *BETA_RANGE) for name in names if name.startswith("beta_")})
    rows = [known.get(name, (LOCAL_CHANGE_STD, *LOCAL_CHANGE_RANGE)) for name in names]
    return ShapePrior(defaults.double(), *torch.tensor(rows, dtype=torch.float64).unbind(1))


@dataclass(frozen=True)
class PosePrior:
    """Axes (rows), expected angles with their deviations, and limits of every active joint."""

    axes: Float[Tensor, "j 3 3"]
    mean_rad: Float[Tensor, "j 3"]
    std_rad: Float[Tensor, "j 3"]
    limits: JointLimits


def pose_prior(model: LinearBody) -> PosePrior:
    """The prior for a skeleton's rest pose: hinge axes and limits follow from its joints."""
    axes = torch.eye(3, dtype=torch.float64).repeat(len(ACTIVE_JOINTS), 1, 1)
    std = torch.zeros(len(ACTIVE_JOINTS), 3, dtype=torch.float64)
    for joint, joint_type in enumerate(map(strip_side, ACTIVE_JOINTS)):
        if joint_type in HINGE_JOINT_STD_RAD:
            axes[joint], _ = hinge_axes(model, joint)
        std[joint] = torch.tensor({**BALL_JOINT_STD_RAD, **HINGE_JOINT_STD_RAD}[joint_type], dtype=torch.float64)
    return PosePrior(axes, torch.zeros_like(std), std, joint_limits(model))


def adapt_pose_prior(prior: PosePrior, rotations: Float[Tensor, "n j 3 3"]) -> PosePrior:
    """The prior with the joints that a recording hardly moves held near their mean over its n frames.

    A person who turns in one pose is seen from all sides: each side tells what is depth from the others. Only axes
    that the prior leaves loose take part, and only while they spread less than `STATIC_SPREAD_RAD`.
    """
    angle = (prior.axes @ rotation_to_axis_angle(rotations)[..., None]).squeeze(-1)
    spread = SPREAD_FACTOR * (angle.var(0, correction=0) + MIN_SPREAD_RAD**2).sqrt()
    is_static = (prior.std_rad >= LOOSE_STD_RAD) & (prior.std_rad < UNCONSTRAINED_RAD) & (spread < STATIC_SPREAD_RAD)
    return replace(
        prior,
        mean_rad=torch.where(is_static, angle.mean(0), prior.mean_rad),
        std_rad=torch.where(is_static, spread, prior.std_rad),
    )


def rotation_to_axis_angle(rotation: Float[Tensor, "*n 3 3"]) -> Float[Tensor, "*n 3"]:
    """Rotation vector (rad) of a rotation matrix."""
    return quaternion_to_axis_angle(matrix_to_quaternion(rotation))


def skew_symmetric(vector: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3 3"]:
    """[v]x, so that [v]x u = v x u."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    rows = [torch.stack([zero, -z, y], -1), torch.stack([z, zero, -x], -1), torch.stack([-y, x, zero], -1)]
    return torch.stack(rows, dim=-2)


def inverse_left_jacobian_so3(vector: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3 3"]:
    """Derivative of log(exp(delta) exp(vector)) by delta at 0: the inverse left Jacobian of SO(3)."""
    angle = vector.norm(dim=-1)[..., None, None].clamp(min=1e-4, max=3.1)
    bracket = skew_symmetric(vector)
    curve = 1.0 / angle**2 - (1.0 + torch.cos(angle)) / (2.0 * angle * torch.sin(angle))
    return torch.eye(3, dtype=vector.dtype) - 0.5 * bracket + curve * (bracket @ bracket)


def pose_residuals(
    prior: PosePrior, rotations: Float[Tensor, "n j 3 3"]
) -> tuple[Float[Tensor, "n j 6"], Float[Tensor, "n j 6 3"]]:
    """Deviations from the expected pose and excess over joint limits, and their derivative by the joint's rotation."""
    vector = rotation_to_axis_angle(rotations)
    angle = (prior.axes @ vector[..., None]).squeeze(-1)
    rotation_jacobian = prior.axes @ inverse_left_jacobian_so3(vector)
    excess, excess_rotation_jacobian = prior.limits.residuals(rotations)
    residual = torch.cat([(angle - prior.mean_rad) / prior.std_rad, excess], dim=-1)
    return residual, torch.cat([rotation_jacobian / prior.std_rad[..., None], excess_rotation_jacobian], dim=-2)


def acceleration_factors(
    time_s: Float[Tensor, "n"],
) -> tuple[Float[Tensor, "t"], Float[Tensor, "t"], Float[Tensor, "t"]]:
    """For each inner frame: factors on the step before it, the step after it, and on the whole residual.

    Velocities are taken over the true intervals; a change of velocity is allowed in proportion to the root of the time
    it took (white acceleration), so that dropped frames loosen the coupling.
    """
    interval = torch.diff(time_s).clamp(min=1e-4) / REFERENCE_INTERVAL_S
    before, after = 1.0 / interval[:-1], 1.0 / interval[1:]
    return before, after, 1.0 / (0.5 * (interval[:-1] + interval[1:])).sqrt()


def motion_residuals(
    rotations: Float[Tensor, "n j 3 3"], root_perspective: Float[Tensor, "n 3"], time_s: Float[Tensor, "n"]
) -> Float[Tensor, "t p"]:
    """Change of velocity at each inner frame: joint rotations (rad a frame), then `fit_place`.

    To first order its derivative by the rotation steps of frames t - 1, t, t + 1 is (before, -before - after, after).
    """
    steps = rotation_to_axis_angle(rotations[1:] @ rotations[:-1].transpose(-1, -2)).flatten(1)
    steps = torch.cat([steps, torch.diff(root_perspective, dim=0)], dim=1)
    before, after, scale = acceleration_factors(time_s)
    return (steps[1:] * after[:, None] - steps[:-1] * before[:, None]) * scale[:, None]


def default_motion_std(joints: int) -> Float[Tensor, "p"]:
    """Standard deviations of `motion_residuals` when nothing is known about the motion."""
    std = torch.full((3 * joints + 3,), MOTION_STD_RAD, dtype=torch.float64)
    std[-3:] = MOTION_ROOT_STD
    return std


def estimate_motion_std(
    rotations: Float[Tensor, "n j 3 3"], root_perspective: Float[Tensor, "n 3"], time_s: Float[Tensor, "n"]
) -> Float[Tensor, "p"]:
    """Standard deviations of `motion_residuals` for the person in this recording, one a joint, from its fitted poses.

    Errors that change from frame to frame look like motion, but do not add up. With k times the interval, the squared
    residual of white acceleration of variance s^2 under white noise is s^2 + noise / k^3; from k = 1 and
    `MOTION_LAG` follows s^2. `MOTION_STD_FACTOR` times s is allowed, at least `MIN_MOTION_RATIO` of
    `default_motion_std`, at most all.
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
