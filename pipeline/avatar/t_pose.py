"""The T-pose of VRM: arms and fingers along x, palms down, legs vertical, feet forward.

Reference: https://github.com/vrm-c/vrm-specification/blob/master/specification/VRMC_vrm-1.0/tpose.md. Spine, neck, head
and shoulders stay as they are in the A-pose.
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.geometry.rotation import rotation_between

_DOWN, _OUT, _THUMB = (0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (1.0, 0.0, 1.0)
_BONE_DIRECTIONS = {
    "UpLeg": ("Leg", _DOWN),
    "Leg": ("Foot", _DOWN),
    "Arm": ("ForeArm", _OUT),
    "ForeArm": ("Hand", _OUT),
    "Hand": ("HandMiddle1", _OUT),
    "HandThumb1": ("HandThumb2", _THUMB),
    "HandThumb2": ("HandThumb3", _THUMB),
} | {
    f"Hand{finger}{bone}": (f"Hand{finger}{bone + 1}", _OUT)
    for finger in ("Index", "Middle", "Ring", "Pinky")
    for bone in (1, 2)
}
"""Child joint and direction of the bone in the T-pose, for the left side; mirrored in x for the right."""


def t_pose_transforms(
    joint_names: Sequence[str], parents: Int[np.ndarray, "j"], joints_m: Float[np.ndarray, "j 3"]
) -> Float[np.ndarray, "j 4 4"]:
    """Return the transform of each joint's rigid part from the bind pose to the T-pose; the root does not move.

    A joint whose direction is not defined, or whose child the skeleton lacks, turns with its parent; feet keep their
    pitch and point forward.

    Args:
        joint_names: Mixamo's names.
        parents: index of each joint's parent, which comes before it; -1 for the root.
        joints_m: positions in the bind pose, +Y up, facing +Z.
    """
    index = {name: joint for joint, name in enumerate(joint_names)}
    bind_m = torch.from_numpy(joints_m.astype(np.float64))
    transforms = torch.eye(4, dtype=torch.float64).repeat(len(joint_names), 1, 1)
    for joint, (name, parent) in enumerate(zip(joint_names, parents.tolist(), strict=True)):
        turn, position_m = torch.eye(3, dtype=torch.float64), bind_m[joint]
        if parent >= 0:
            turn = transforms[parent, :3, :3]
            position_m = turn @ position_m + transforms[parent, :3, 3]
        side = name.removeprefix("Left") if name.startswith("Left") else name.removeprefix("Right")
        prefix = name.removesuffix(side)
        if side == "Foot" and prefix + "ToeBase" in index:
            turn = _foot_forward(bind_m[index[prefix + "ToeBase"]] - bind_m[joint])
        elif side in _BONE_DIRECTIONS and prefix and prefix + _BONE_DIRECTIONS[side][0] in index:
            child, direction = _BONE_DIRECTIONS[side]
            mirror = torch.tensor([1.0 if prefix == "Left" else -1.0, 1.0, 1.0], dtype=torch.float64)
            bone = turn @ (bind_m[index[prefix + child]] - bind_m[joint])
            turn = rotation_between(bone, torch.tensor(direction, dtype=torch.float64) * mirror) @ turn
            if side == "Hand" and {prefix + "HandIndex1", prefix + "HandPinky1"} <= set(index):
                across = turn @ (bind_m[index[prefix + "HandIndex1"]] - bind_m[index[prefix + "HandPinky1"]])
                turn = _palm_down(across) @ turn
        transforms[joint, :3, :3] = turn
        transforms[joint, :3, 3] = position_m - turn @ bind_m[joint]
    return transforms.numpy()


def _foot_forward(foot: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """Return the rotation about y that takes a foot to a plane of constant x, towards +Z."""
    flat = foot * foot.new_tensor([1.0, 0.0, 1.0])
    return rotation_between(flat, foot.new_tensor([0.0, 0.0, 1.0]))


def _palm_down(across: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """Return the rotation about x that takes the direction from the little to the index finger to the front."""
    return rotation_between(across * across.new_tensor([0.0, 1.0, 1.0]), across.new_tensor([0.0, 0.0, 1.0]))
