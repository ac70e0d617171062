"""VRM's names of the human bones for the joints of the avatar's skeleton."""

from collections.abc import Sequence
from typing import Literal

VrmVersion = Literal["0.x", "1.0"]

_TORSO = {
    "Hips": "hips",
    "Spine": "spine",
    "Spine1": "chest",
    "Spine2": "upperChest",
    "Neck": "neck",
    "Head": "head",
    "Jaw": "jaw",
}
_LIMBS = {
    "UpLeg": "UpperLeg",
    "Leg": "LowerLeg",
    "Foot": "Foot",
    "ToeBase": "Toes",
    "Shoulder": "Shoulder",
    "Arm": "UpperArm",
    "ForeArm": "LowerArm",
    "Hand": "Hand",
    "Eye": "Eye",
}
_FINGERS = {"Index": "Index", "Middle": "Middle", "Ring": "Ring", "Pinky": "Little"}
_PHALANGES = ("Proximal", "Intermediate", "Distal")
_THUMB: dict[VrmVersion, tuple[str, ...]] = {"0.x": _PHALANGES, "1.0": ("Metacarpal", "Proximal", "Distal")}
_REQUIRED = {"hips", "spine", "chest", "neck", "head"} | {
    side + limb
    for side in ("left", "right")
    for limb in ("UpperLeg", "LowerLeg", "Foot", "UpperArm", "LowerArm", "Hand")
}
"""Bones that either version requires."""


def human_bones(joint_names: Sequence[str], version: VrmVersion) -> dict[str, int]:
    """Return the index of the joint of each human bone, in VRM's names; other joints have no bone.

    joint_names: Mixamo's names.

    Raises:
        ValueError: a bone that VRM requires is missing.
    """
    names = dict(_TORSO)
    for side in ("Left", "Right"):
        names |= {side + joint: side.lower() + bone for joint, bone in _LIMBS.items()}
        for number in range(3):
            thumb = _THUMB[version][number]
            names[f"{side}HandThumb{number + 1}"] = f"{side.lower()}Thumb{thumb}"
            for joint, bone in _FINGERS.items():
                names[f"{side}Hand{joint}{number + 1}"] = f"{side.lower()}{bone}{_PHALANGES[number]}"
    bones = {names[joint]: index for index, joint in enumerate(joint_names) if joint in names}
    missing = sorted(_REQUIRED - set(bones))
    if missing:
        raise ValueError(f"a VRM needs the bones {', '.join(missing)}, which the skeleton does not have")
    return bones
