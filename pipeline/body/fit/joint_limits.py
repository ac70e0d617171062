"""How far the joints of a living person go, and what a pose costs beyond that.

A joint's rotation away from the middle of its range is split into the swing of its bone, whose rotation vector is
perpendicular to the bone, and the twist about the bone (swing-twist decomposition; Baerlocher and Boulic,
"Parametrization and range of motion of the ball-and-socket joint", 2001). That gives three angles: twist, flexion,
sideways. Counted from the middle they have no pole within reach, so each has a range of its own.

Ranges: American Academy of Orthopaedic Surgeons, "Joint motion: method of measuring and recording", 1965; Boone and
Azen, "Normal range of motion of joints in male subjects", 1979, found the like. Healthy people differ by 5 to 10
degrees (standard deviation) and trained ones go further: `LIMIT_MARGIN_DEG` is added at both ends.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from pipeline.body.fit.linear_body import ACTIVE_JOINTS, LinearBody
from pipeline.geometry.rotation import axis_angle_to_matrix

LIMIT_STD_RAD = 0.06
"""Softness of a limit: going this far beyond costs one standard deviation."""

LIMIT_MARGIN_DEG = 15.0
UNLIMITED_DEG = 600.0

Range = tuple[float, float]
Vector = tuple[float, float, float]

_DOWN, _UP, _LEFT = (0.0, -1.0, 0.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)
_FLEXION_AXIS = {_DOWN: (-1.0, 0.0, 0.0), _UP: (1.0, 0.0, 0.0), _LEFT: (0.0, -1.0, 0.0)}
"""About which axis a bone that points there turns forward."""

BALL_JOINT_RANGES_DEG: dict[str, tuple[Vector, Range, Range, Range]] = {
    # each joint of the trunk may take half of the whole range: recordings seldom share it evenly
    "Spine": (_UP, (-22, 22), (-12, 40), (-18, 18)),
    "Spine1": (_UP, (-22, 22), (-12, 40), (-18, 18)),
    "Spine2": (_UP, (-22, 22), (-12, 40), (-18, 18)),
    # recordings bend the neck alone and turn the head alone
    "Neck": (_UP, (-30, 30), (-45, 45), (-45, 45)),
    "Head": (_UP, (-60, 60), (-22, 22), (-22, 22)),
    "Shoulder": (_LEFT, (-15, 15), (-15, 15), (-45, 10)),
    # a hand behind the back is turned further inward than the 70 that are measured with the arm held sideways
    "Arm": (_LEFT, (-100, 100), (-45, 135), (-90, 120)),
    # 45 to the side and in twist when one at a time is measured; a high kick to the side takes more of both
    "UpLeg": (_DOWN, (-60, 60), (-30, 120), (-90, 30)),
    # flexion: 20 without load, 40 in a squat; twist: with the shin, since the knee here hardly turns it
    "Foot": (_DOWN, (-40, 40), (-50, 40), (-15, 35)),
    "ToeBase": (_DOWN, (-10, 10), (-45, 70), (-10, 10)),
    "Hand": (_LEFT, (-80, 80), (-70, 80), (-20, 30)),
}
"""Where a left joint's bone points at the anatomist's zero, and its ranges of twist, flexion, sideways swing (degrees).

Positive is inward, forward (toes up, palm in), and towards the middle or, for arm and hand, down. Zero is the rest
pose, but for upper arms and thighs, which count from where the table points.
"""

HINGE_RANGES_DEG: dict[str, tuple[Range, Range, Range]] = {
    "ForeArm": ((-95, 95), (-3, 149), (-UNLIMITED_DEG, UNLIMITED_DEG)),
    "Leg": ((-UNLIMITED_DEG, UNLIMITED_DEG), (-3, 155), (-UNLIMITED_DEG, UNLIMITED_DEG)),
}
"""Elbows and knees, flexion counted from the straight limb (the knee's as in kneeling); without a margin."""

_CHILD_JOINT = {"Arm": "ForeArm", "UpLeg": "Leg"}


def swing_twist(rotation: Float[Tensor, "*n 3 3"]) -> tuple[Float[Tensor, "*n 3"], Float[Tensor, "*n 3 3"]]:
    """Twist about the x axis and swing of it about y and z (rad), R = exp(swing) exp(twist), and their derivative.

    The derivative is by delta in exp(delta) R. Twist lies in [-pi, pi]; both are undefined where x is turned round.
    """
    bone = rotation[..., :, 0]
    cross = torch.linalg.vector_norm(bone[..., 1:], dim=-1)
    angle = torch.atan2(cross, bone[..., 0])
    stretch = torch.where(cross > 1e-6, angle / cross.clamp(min=1e-6), 1.0)[..., None]
    twist = torch.atan2(rotation[..., 2, 1] - rotation[..., 1, 2], rotation[..., 1, 1] + rotation[..., 2, 2])
    away = stretch * bone[..., 1:]  # where the bone is on the sphere, seen from x: the swing turned back by 90 degrees
    angles = torch.stack([twist, -away[..., 1], away[..., 0]], dim=-1)

    angle = angle[..., None, None].clamp(min=1e-3)
    curve = (1.0 - angle / torch.tan(angle)) / angle**2
    by_swing = torch.eye(2).to(away) - curve * (away[..., :, None] * away[..., None, :])
    above = torch.cat([torch.ones_like(twist)[..., None], bone[..., 1:] / (1.0 + bone[..., :1])], dim=-1)
    return angles, torch.cat([above[..., None, :], torch.cat([-away[..., None], by_swing], dim=-1)], dim=-2)


@dataclass(frozen=True)
class JointLimits:
    """Of every active joint: the way back from the middle of its range, its axes there (rows: bone, flexion, sideways;
    coordinates of the parent), and how far each angle may go from there (rad)."""

    range_centre_to_rest: Float[Tensor, "j 3 3"]
    axes: Float[Tensor, "j 3 3"]
    half_range_rad: Float[Tensor, "j 3"]

    def angles(self, rotations: Float[Tensor, "n j 3 3"]) -> tuple[Float[Tensor, "n j 3"], Float[Tensor, "n j 3 3"]]:
        """Twist, flexion and sideways swing from the middle (rad), and their derivative by the joint's rotation."""
        angles, derivative = swing_twist(
            self.axes @ rotations @ self.range_centre_to_rest @ self.axes.transpose(-1, -2)
        )
        return angles, derivative @ self.axes

    def residuals(self, rotations: Float[Tensor, "n j 3 3"]) -> tuple[Float[Tensor, "n j 3"], Float[Tensor, "n j 3 3"]]:
        """How far each angle is beyond its range, over `LIMIT_STD_RAD` (0 inside), and the derivative of that."""
        angles, derivative = self.angles(rotations)
        excess = angles - torch.minimum(torch.maximum(angles, -self.half_range_rad), self.half_range_rad)
        outside = (excess != 0).to(angles.dtype) / LIMIT_STD_RAD
        return excess / LIMIT_STD_RAD, derivative * outside[..., None]


def joint_limits(model: LinearBody) -> JointLimits:
    """The limits of any body with these joints' names that rests in the A-pose; the root has none."""
    axes = torch.eye(3, dtype=torch.float64).repeat(len(ACTIVE_JOINTS), 1, 1)
    rest_to_range_centre, half_range_deg = (
        axes.clone(),
        torch.full((len(ACTIVE_JOINTS), 3), UNLIMITED_DEG, dtype=torch.float64),
    )
    for joint, name in enumerate(ACTIVE_JOINTS):
        joint_type = strip_side(name)
        if joint_type in HINGE_RANGES_DEG:
            rest_axes, rest_flexion_rad = hinge_axes(model, joint)
            to_zero, ranges = (
                torch.eye(3, dtype=torch.float64),
                torch.tensor(HINGE_RANGES_DEG[joint_type], dtype=torch.float64),
            )
            ranges[1] -= rest_flexion_rad * 180.0 / torch.pi
        elif joint_type in BALL_JOINT_RANGES_DEG:
            rest_axes, to_zero, ranges = _ball_joint_frame(model, joint)
        else:
            continue
        middle = ranges.mean(1).deg2rad()
        half_range_deg[joint] = 0.5 * (ranges[:, 1] - ranges[:, 0])
        swing = axis_angle_to_matrix(rest_axes[1:].T @ middle[1:])
        rest_to_range_centre[joint] = swing @ axis_angle_to_matrix(rest_axes[0] * middle[0]) @ to_zero
        axes[joint] = rest_axes @ swing.T
    return JointLimits(rest_to_range_centre.transpose(-1, -2), axes, half_range_deg.deg2rad())


def strip_side(name: str) -> str:
    """A joint's name without its side."""
    return name.removeprefix("Left").removeprefix("Right")


def hinge_axes(model: LinearBody, joint: int) -> tuple[Float[Tensor, "3 3"], float]:
    """Rows (along the bone, flexion axis, sideways) of an elbow or knee, and how far the rest pose bends it (rad)."""
    parent, child = model.parents[joint], model.parents.index(joint)
    upper = normalize(model.joints[joint] - model.joints[parent], dim=0)
    lower = normalize(model.joints[child] - model.joints[joint], dim=0)
    bend = torch.linalg.cross(upper, lower)
    if strip_side(ACTIVE_JOINTS[joint]) == "Leg":  # nearly straight, so its axis is the body's x: positive bends it
        flexion, bent = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64), float(bend[0])
    else:
        flexion, bent = normalize(bend, dim=0), float(torch.asin(bend.norm()))
    along = normalize(lower - (lower @ flexion) * flexion, dim=0)
    return torch.stack([along, flexion, torch.linalg.cross(along, flexion)]), bent


def _ball_joint_frame(
    model: LinearBody, joint: int
) -> tuple[Float[Tensor, "3 3"], Float[Tensor, "3 3"], Float[Tensor, "3 2"]]:
    """Axes at the anatomist's zero, rotation from rest to there, and ranges with their margin (degrees).

    The right side mirrors the left: directions along x, and rotations about all axes but the one of flexion.
    """
    name = ACTIVE_JOINTS[joint]
    joint_type, mirror = strip_side(name), -1.0 if name.startswith("Right") else 1.0
    direction, *ranges_deg = BALL_JOINT_RANGES_DEG[joint_type]
    bone = torch.tensor(direction, dtype=torch.float64)
    flexion = torch.tensor(_FLEXION_AXIS[direction], dtype=torch.float64)
    if joint_type == "Hand":
        bone, flexion = _hand_axes(model)
    bone, flexion = bone * bone.new_tensor([mirror, 1.0, 1.0]), flexion * bone.new_tensor([1.0, mirror, mirror])
    to_zero = torch.eye(3, dtype=torch.float64)
    if joint_type in _CHILD_JOINT:
        child = ACTIVE_JOINTS.index(name.replace(joint_type, _CHILD_JOINT[joint_type]))
        rest = normalize(model.joints[child] - model.joints[joint], dim=0)
        across = torch.linalg.cross(rest, bone)
        to_zero = axis_angle_to_matrix(normalize(across, dim=0) * torch.atan2(across.norm(), rest @ bone))
    margin = torch.tensor([-LIMIT_MARGIN_DEG, LIMIT_MARGIN_DEG], dtype=torch.float64)
    ranges = torch.tensor(ranges_deg, dtype=torch.float64) + margin
    if mirror < 0:
        ranges[[0, 2]] = -ranges[[0, 2]].flip(1)
    return torch.stack([bone, flexion, torch.linalg.cross(bone, flexion)]), to_zero, ranges


def _hand_axes(model: LinearBody) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Where the left hand points at rest, and the axis about which it bends towards its palm."""
    wrist, index, little = (
        torch.tensor(model.landmark_positions_m[name], dtype=torch.float64) for name in ("wrist", "index", "pinky")
    )
    bone = normalize(0.5 * (index + little) - wrist, dim=0)
    across = little - index
    return bone, normalize(across - (across @ bone) * bone, dim=0)
