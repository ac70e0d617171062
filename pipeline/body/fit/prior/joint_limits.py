"""Joint limits of living people, and residuals of poses beyond them.

A joint's rotation away from the centre of its range is split into the swing of its bone, whose rotation vector is
perpendicular to the bone, and the twist about the bone (swing-twist decomposition; Baerlocher and Boulic,
"Parametrization and range of motion of the ball-and-socket joint", 2001). That gives three angles: twist, flexion,
sideways swing. Measured from the centre they have no singularity within the range.

Ranges: American Academy of Orthopaedic Surgeons, "Joint motion: method of measuring and recording", 1965; Boone and
Azen, "Normal range of motion of joints in male subjects", 1979, agree. Healthy people differ by 5 to 10 degrees
(standard deviation) and trained ones exceed that: `LIMIT_MARGIN_DEG` is added at both ends.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from pipeline.body.fit.linear_body import ACTIVE_JOINTS, LinearBody
from pipeline.geometry.rotation import axis_angle_to_matrix

LIMIT_STD_RAD = 0.06
"""Excess over a limit that counts as one standard deviation."""

LIMIT_MARGIN_DEG = 15.0
UNLIMITED_DEG = 600.0

Range = tuple[float, float]
Vector = tuple[float, float, float]

_DOWN, _UP, _LEFT = (0.0, -1.0, 0.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)
_FLEXION_AXIS = {_DOWN: (-1.0, 0.0, 0.0), _UP: (1.0, 0.0, 0.0), _LEFT: (0.0, -1.0, 0.0)}
"""Axis about which a bone of this direction flexes forward."""

BALL_JOINT_RANGES_DEG: dict[str, tuple[Vector, Range, Range, Range]] = {
    # each joint of the trunk has half of the whole range: recordings seldom distribute it evenly
    "Spine": (_UP, (-22, 22), (-12, 40), (-18, 18)),
    "Spine1": (_UP, (-22, 22), (-12, 40), (-18, 18)),
    "Spine2": (_UP, (-22, 22), (-12, 40), (-18, 18)),
    # recordings bend only the neck and turn only the head
    "Neck": (_UP, (-30, 30), (-45, 45), (-45, 45)),
    "Head": (_UP, (-60, 60), (-22, 22), (-22, 22)),
    "Shoulder": (_LEFT, (-15, 15), (-15, 15), (-45, 10)),
    # a hand behind the back has more inward twist than the 70 measured with the arm held sideways
    "Arm": (_LEFT, (-100, 100), (-45, 135), (-90, 120)),
    # 45 sideways and in twist if measured separately; a high kick to the side exceeds both
    "UpLeg": (_DOWN, (-60, 60), (-30, 120), (-90, 30)),
    # flexion: 20 without load, 40 in a squat; twist: includes the shin, which the knee here hardly twists
    "Foot": (_DOWN, (-40, 40), (-50, 40), (-15, 35)),
    "ToeBase": (_DOWN, (-10, 10), (-45, 70), (-10, 10)),
    "Hand": (_LEFT, (-80, 80), (-70, 80), (-20, 30)),
}
"""Direction of a left joint's bone in the anatomical neutral position, and ranges of twist, flexion, sideways swing
(degrees).

Positive is inward, forward (toes up, palm in), and towards the middle or, for arm and hand, down. Zero is the rest
pose, except for upper arms and thighs, where it is the direction in the table.
"""

HINGE_RANGES_DEG: dict[str, tuple[Range, Range, Range]] = {
    "ForeArm": ((-95, 95), (-3, 149), (-UNLIMITED_DEG, UNLIMITED_DEG)),
    "Leg": ((-UNLIMITED_DEG, UNLIMITED_DEG), (-3, 155), (-UNLIMITED_DEG, UNLIMITED_DEG)),
}
"""Elbows and knees; flexion from the straight limb, maximum of the knee as in kneeling; without a margin."""

_CHILD_JOINT = {"Arm": "ForeArm", "UpLeg": "Leg"}


def swing_twist(rotation: Float[Tensor, "*n 3 3"]) -> tuple[Float[Tensor, "*n 3"], Float[Tensor, "*n 3 3"]]:
    """Decompose rotations into twist about the x axis and swing about y and z: R = exp(swing) exp(twist).

    Returns (twist, swing y, swing z) in rad and their derivative with respect to delta in exp(delta) R. The twist is in
    [-pi, pi]; both are undefined where x is reversed.
    """
    bone = rotation[..., :, 0]
    cross = torch.linalg.vector_norm(bone[..., 1:], dim=-1)
    angle = torch.atan2(cross, bone[..., 0])
    stretch = torch.where(cross > 1e-6, angle / cross.clamp(min=1e-6), 1.0)[..., None]
    twist = torch.atan2(rotation[..., 2, 1] - rotation[..., 1, 2], rotation[..., 1, 1] + rotation[..., 2, 2])
    tangent = stretch * bone[..., 1:]  # logarithm map of the bone direction at x: the swing rotated by -90 degrees
    angles = torch.stack([twist, -tangent[..., 1], tangent[..., 0]], dim=-1)

    angle = angle[..., None, None].clamp(min=1e-3)
    curve = (1.0 - angle / torch.tan(angle)) / angle**2
    swing_jacobian = torch.eye(2).to(tangent) - curve * (tangent[..., :, None] * tangent[..., None, :])
    twist_jacobian = torch.cat([torch.ones_like(twist)[..., None], bone[..., 1:] / (1.0 + bone[..., :1])], dim=-1)
    swing_rows = torch.cat([-tangent[..., None], swing_jacobian], dim=-1)
    return angles, torch.cat([twist_jacobian[..., None, :], swing_rows], dim=-2)


@dataclass(frozen=True)
class JointLimits:
    """Limits of every active joint.

    range_centre_to_rest: rotation from the centre of the range to the rest pose.
    axes: rows (bone, flexion axis, sideways axis) at the centre of the range, in the frame of the parent.
    half_range_rad: limit of each angle, measured from the centre.
    """

    range_centre_to_rest: Float[Tensor, "j 3 3"]
    axes: Float[Tensor, "j 3 3"]
    half_range_rad: Float[Tensor, "j 3"]

    def angles(self, rotations: Float[Tensor, "n j 3 3"]) -> tuple[Float[Tensor, "n j 3"], Float[Tensor, "n j 3 3"]]:
        """Return twist, flexion and sideways swing from the centre (rad), and their derivative by the rotation."""
        angles, derivative = swing_twist(
            self.axes @ rotations @ self.range_centre_to_rest @ self.axes.transpose(-1, -2)
        )
        return angles, derivative @ self.axes

    def residuals(self, rotations: Float[Tensor, "n j 3 3"]) -> tuple[Float[Tensor, "n j 3"], Float[Tensor, "n j 3 3"]]:
        """Return the excess of each angle over `LIMIT_STD_RAD` (0 within the range) and its derivative."""
        angles, derivative = self.angles(rotations)
        excess = angles - torch.minimum(torch.maximum(angles, -self.half_range_rad), self.half_range_rad)
        outside = (excess != 0).to(angles.dtype) / LIMIT_STD_RAD
        return excess / LIMIT_STD_RAD, derivative * outside[..., None]


def joint_limits(model: LinearBody) -> JointLimits:
    """Return the limits of a body that rests in the A-pose; the root has none."""
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
        centre_rad = ranges.mean(1).deg2rad()
        half_range_deg[joint] = 0.5 * (ranges[:, 1] - ranges[:, 0])
        swing = axis_angle_to_matrix(rest_axes[1:].T @ centre_rad[1:])
        rest_to_range_centre[joint] = swing @ axis_angle_to_matrix(rest_axes[0] * centre_rad[0]) @ to_zero
        axes[joint] = rest_axes @ swing.T
    return JointLimits(rest_to_range_centre.transpose(-1, -2), axes, half_range_deg.deg2rad())


def strip_side(name: str) -> str:
    """Return the name of a joint without "Left" or "Right"."""
    return name.removeprefix("Left").removeprefix("Right")


def hinge_axes(model: LinearBody, joint: int) -> tuple[Float[Tensor, "3 3"], float]:
    """Return the rows (bone, flexion axis, sideways axis) of an elbow or knee and its flexion at rest (rad)."""
    parent, child = model.parents[joint], model.parents.index(joint)
    upper = normalize(model.joints_m[joint] - model.joints_m[parent], dim=0)
    lower = normalize(model.joints_m[child] - model.joints_m[joint], dim=0)
    bend = torch.linalg.cross(upper, lower)
    if strip_side(ACTIVE_JOINTS[joint]) == "Leg":  # nearly straight, so its flexion axis is the x axis of the body
        flexion, bent = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64), float(bend[0])
    else:
        flexion, bent = normalize(bend, dim=0), float(torch.asin(bend.norm()))
    along = normalize(lower - (lower @ flexion) * flexion, dim=0)
    return torch.stack([along, flexion, torch.linalg.cross(along, flexion)]), bent


def _ball_joint_frame(
    model: LinearBody, joint: int
) -> tuple[Float[Tensor, "3 3"], Float[Tensor, "3 3"], Float[Tensor, "3 2"]]:
    """Return axes in the anatomical neutral position, the rotation from rest to it, and ranges with margin (degrees).

    The right side mirrors the left: directions along x, and rotations about all axes except the flexion axis.
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
        rest = normalize(model.joints_m[child] - model.joints_m[joint], dim=0)
        across = torch.linalg.cross(rest, bone)
        to_zero = axis_angle_to_matrix(normalize(across, dim=0) * torch.atan2(across.norm(), rest @ bone))
    margin = torch.tensor([-LIMIT_MARGIN_DEG, LIMIT_MARGIN_DEG], dtype=torch.float64)
    ranges = torch.tensor(ranges_deg, dtype=torch.float64) + margin
    if mirror < 0:
        ranges[[0, 2]] = -ranges[[0, 2]].flip(1)
    return torch.stack([bone, flexion, torch.linalg.cross(bone, flexion)]), to_zero, ranges


def _hand_axes(model: LinearBody) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Return the direction of the left hand at rest, and the axis about which it bends towards its palm."""
    wrist, index, little = (
        torch.tensor(model.landmark_positions_m[name], dtype=torch.float64) for name in ("wrist", "index", "pinky")
    )
    bone = normalize(0.5 * (index + little) - wrist, dim=0)
    across = little - index
    return bone, normalize(across - (across @ bone) * bone, dim=0)
