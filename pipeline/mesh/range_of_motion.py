"""Poses that a person who walks, squats, or raises the arms takes: where skin weights that jump tear the surface."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from pipeline.body.body import Body, Motion, canonical_to_world

_X, _Z = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)


class _Turn(NamedTuple):
    """A rotation (deg) of a joint about an axis of the world, for the left side; mirrored for the right."""

    joint: str
    axis: tuple[float, float, float]
    angle_deg: float


class _Pose(NamedTuple):
    """Turns of both sides, of one side (a second pose has them on the other), and the direction of the upper arms."""

    both: tuple[_Turn, ...] = ()
    one: tuple[_Turn, ...] = ()
    other: tuple[_Turn, ...] = ()
    arm: tuple[float, float, float] | None = None


POSES = (
    _Pose(both=(_Turn("Shoulder", _Z, 25.0), _Turn("Arm", _Z, 95.0))),
    _Pose(both=(_Turn("Arm", _Z, 50.0),)),
    _Pose(arm=(0.1, 0.0, 1.0)),
    _Pose(arm=(0.2, 0.9, 0.5)),
    _Pose(arm=(-0.6, -0.1, 0.8)),
    _Pose(arm=(0.7, 0.3, 0.7)),
    _Pose(
        one=(_Turn("UpLeg", _X, -45.0), _Turn("Leg", _X, 20.0)),
        other=(_Turn("UpLeg", _X, 30.0), _Turn("Leg", _X, 20.0)),
    ),
    _Pose(
        one=(_Turn("UpLeg", _X, -85.0), _Turn("Leg", _X, 90.0)),
        other=(_Turn("UpLeg", _X, 25.0), _Turn("Leg", _X, 25.0)),
    ),
    _Pose(one=(_Turn("UpLeg", _Z, 45.0),)),
    _Pose(one=(_Turn("UpLeg", (-0.92, 0.0, 0.4), 76.0), _Turn("Leg", _X, 80.0))),
    _Pose(both=(_Turn("UpLeg", _X, -95.0), _Turn("Leg", _X, 110.0), _Turn("Spine", _X, 25.0))),
    _Pose(both=(_Turn("UpLeg", _Z, 30.0),)),
)
"""Arms up, level, forward, forward and up, across, outward; a step, a lunge, a leg to the side, a knee raised outward;
a squat; legs apart. Angles are within the range of motion of adults; no pose is taken from a clip."""


def sample_poses(body: Body) -> Float[Tensor, "n j 4 4"]:
    """Return the skinning matrices of `POSES` for a body with Mixamo's joint names.

    Joints that the body lacks do not turn. Poses with turns of one side are there for both sides.
    """
    rows = [_rotations(body, pose, first) for pose in POSES for first in (("Left", "Right") if pose.one else ("Left",))]
    rotations_wxyz = np.stack(rows).astype(np.float32)
    count = len(rows)
    root_m = np.tile(body.joints_m[:1], (count, 1)).astype(np.float32)
    return canonical_to_world(
        body, Motion(np.arange(count, dtype=np.int32), np.arange(count) / 1.0, rotations_wxyz, root_m)
    )


def _rotations(body: Body, pose: _Pose, first: str) -> Float[np.ndarray, "j 4"]:
    """Return the local rotations (wxyz) of one pose; the turns of one side are on the side `first`."""
    rotations = np.tile([1.0, 0.0, 0.0, 0.0], (len(body.joint_names), 1))
    second = "Right" if first == "Left" else "Left"
    turns = [(side, turn) for side in (first, second) for turn in pose.both]
    turns += [(first, turn) for turn in pose.one] + [(second, turn) for turn in pose.other]
    for side, turn in turns:
        name = turn.joint if turn.joint in body.joint_names else side + turn.joint
        if name in body.joint_names:
            mirror = np.array([1.0, -1.0, -1.0]) if side == "Right" else np.ones(3)
            axis = np.array(turn.axis) / np.linalg.norm(turn.axis) * (mirror if name.startswith(side) else 1.0)
            rotations[body.joint(name)] = _wxyz(Rotation.from_rotvec(np.radians(turn.angle_deg) * axis))
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        if pose.arm is not None and {side + "Arm", side + "ForeArm"} <= set(body.joint_names):
            bone = body.joints_m[body.joint(side + "ForeArm")] - body.joints_m[body.joint(side + "Arm")]
            towards = np.array(pose.arm) * [sign, 1.0, 1.0]
            rotations[body.joint(side + "Arm")] = _wxyz(Rotation.align_vectors(towards[None], bone[None])[0])
    return rotations


def _wxyz(rotation: Rotation) -> Float[np.ndarray, "4"]:
    return np.asarray(rotation.as_quat())[[3, 0, 1, 2]]
