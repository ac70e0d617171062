"""Which part of the body a joint belongs to, from its Mixamo name."""

import numpy as np
from jaxtyping import Float, Int

BODY_PARTS = ("torso", "head", "left arm", "right arm", "left hand", "right hand", "left leg", "right leg")
_LIMBS = {"Shoulder": "arm", "ForeArm": "arm", "Arm": "arm", "UpLeg": "leg", "Leg": "leg", "Foot": "leg", "Toe": "leg"}


def body_part_of_joint(name: str) -> str:
    """One of `BODY_PARTS`; what is neither head nor limb is torso.

    >>> part_of_joint("LeftHandIndex1"), part_of_joint("Neck"), part_of_joint("RightToeBase")
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
    """Index into `BODY_PARTS` of every face: the part whose joints weigh most at its corners together."""
    of_joint = np.array([BODY_PARTS.index(body_part_of_joint(name)) for name in joint_names])
    share = np.zeros((len(joint_indices), len(BODY_PARTS)))
    np.add.at(share, (np.arange(len(share))[:, None], of_joint[joint_indices]), joint_weights)
    return share[faces].sum(axis=1).argmax(axis=1).astype(np.int32)
