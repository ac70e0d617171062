"""Assign joints and mesh faces to body parts by the Mixamo names of the joints."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

BODY_PARTS = ("torso", "head", "left arm", "right arm", "left hand", "right hand", "left leg", "right leg")
_LIMBS = {"Shoulder": "arm", "ForeArm": "arm", "Arm": "arm", "UpLeg": "leg", "Leg": "leg", "Foot": "leg", "Toe": "leg"}


def body_part_of_joint(name: str) -> str:
    """Return the entry of `BODY_PARTS` for a joint name; "torso" for joints of neither head nor limbs.

    >>> body_part_of_joint("LeftHandIndex1"), body_part_of_joint("Neck"), body_part_of_joint("RightToeBase")
    ('left hand', 'torso', 'right leg')
    """
    if name.startswith("Head"):
        return "head"
    side = next((side for side in ("Left", "Right") if name.startswith(side)), None)
    if side is None:
        return "torso"
    if name[len(side) :].startswith("Hand"):
        return f"{side.lower()} hand"
    limb = next((limb for start, limb in _LIMBS.items() if name[len(side) :].startswith(start)), None)
    return f"{side.lower()} {limb}" if limb else "torso"


def body_part_of_faces(
    faces: Int[np.ndarray, "f 3"],
    joint_indices: Int[np.ndarray, "v k"],
    joint_weights: Float[np.ndarray, "v k"],
    joint_names: tuple[str, ...],
) -> Int[np.ndarray, "f"]:
    """Return the index into `BODY_PARTS` of every face: the part with the largest summed skin weight at its corners.

    joint_indices: into `joint_names`, k influences per vertex. joint_weights: rows sum to 1.
    """
    part_weight = body_part_weights(joint_indices, joint_weights, joint_names)
    return part_weight[faces].sum(axis=1).argmax(axis=1).astype(np.int32)


def body_part_weights(
    joint_indices: Int[np.ndarray, "v k"], joint_weights: Float[np.ndarray, "v k"], joint_names: Sequence[str]
) -> Float[np.ndarray, "v p"]:
    """Return the summed skin weight of each of `BODY_PARTS` at every vertex."""
    part_of_joint = np.array([BODY_PARTS.index(body_part_of_joint(name)) for name in joint_names])
    return group_weights(joint_indices, joint_weights, part_of_joint, len(BODY_PARTS))


def group_weights(
    joint_indices: Int[np.ndarray, "v k"],
    joint_weights: Float[np.ndarray, "v k"],
    group_of_joint: Int[np.ndarray, "j"],
    group_count: int,
) -> Float[np.ndarray, "v g"]:
    """Return the summed skin weight of the joints of each group at every vertex."""
    weight = np.zeros((len(joint_indices), group_count))
    np.add.at(weight, (np.arange(len(weight))[:, None], group_of_joint[joint_indices]), joint_weights)
    return weight
