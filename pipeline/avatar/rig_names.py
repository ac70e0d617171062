"""Names of the joints in the rigs that clips are made for, and which joints of another skeleton they are."""

from collections.abc import Mapping, Sequence
from functools import lru_cache
from os.path import commonprefix
from typing import Literal

from pipeline.avatar.vrm_bones import human_bones

RigName = Literal["plain", "mixamo", "unity", "unreal", "vrm"]
"""plain: Mixamo's names without `mixamorig:`. The others: the programs' own names."""

_TORSO = ("Hips", "Spine", "Spine1", "Spine2", "Neck", "Head")
_LIMBS = ("UpLeg", "Leg", "Foot", "ToeBase", "Shoulder", "Arm", "ForeArm", "Hand")
_FINGERS = ("Thumb", "Index", "Middle", "Ring", "Pinky")
_SIDES = ("Left", "Right")
_MIXAMO = (
    *_TORSO,
    *(side + limb for side in _SIDES for limb in _LIMBS),
    *(f"{side}Hand{finger}{bone}" for side in _SIDES for finger in _FINGERS for bone in (1, 2, 3)),
)

_UNREAL_TORSO = ("pelvis", "spine_01", "spine_02", "spine_03", "neck_01", "head")
_UNREAL_LIMBS = ("thigh", "calf", "foot", "ball", "clavicle", "upperarm", "lowerarm", "hand")

_CMU: dict[str, tuple[str, ...]] = {
    "Spine": ("lowerback", "Chest"),
    "Spine1": ("Chest",),
    "Spine2": ("Chest2", "Spine3"),
    "{side}Shoulder": ("{side}Collar",),
    "{side}Arm": ("{side}Shoulder",),
    "{side}ForeArm": ("{side}Elbow",),
    "{side}Hand": ("{side}Wrist",),
    "{side}UpLeg": ("{side}Hip", "{side}Thigh"),
    "{side}Leg": ("{side}Knee", "{side}Shin"),
    "{side}Foot": ("{side}Ankle",),
    "{side}ToeBase": ("{side}Toe",),
}
"""Names of other motion capture files, of CMU and its kin; a joint that is not listed has Mixamo's name."""


def rig_joint_name(name: str, rig: RigName) -> str:
    """Return the name in `rig` of a joint with Mixamo's name; a joint that the rig does not know keeps its name."""
    return _rig_names(rig).get(name, name)


def match_names(names: Sequence[str]) -> dict[str, int]:
    """Return the index of each joint of a skeleton by Mixamo's name, in the rig whose names match most of its joints.

    Case, namespaces (`mixamorig:`), characters other than letters and digits and a prefix that all joints share do not
    count.
    """
    whole = _match_whole_names(names)
    prefix = len(commonprefix(names))
    return max(whole, _match_whole_names([name[prefix:] for name in names]), key=len) if prefix else whole


def _match_whole_names(names: Sequence[str]) -> dict[str, int]:
    index_of = {_normalise(name): index for index, name in reversed(list(enumerate(names)))}
    tables: list[Mapping[str, tuple[str, ...]]] = [
        {name: (rig_name,) for name, rig_name in _rig_names(rig).items()} for rig in _rigs()
    ]
    found = [_look_up(table, index_of) for table in (*tables, _cmu_names())]
    return max(found, key=len)


def _rigs() -> tuple[RigName, ...]:
    return "plain", "unity", "vrm", "unreal"


@lru_cache
def _rig_names(rig: RigName) -> Mapping[str, str]:
    """Return the names of a rig by Mixamo's name."""
    if rig in ("plain", "mixamo"):
        return {name: ("mixamorig:" if rig == "mixamo" else "") + name for name in _MIXAMO}
    if rig == "unreal":
        names = dict(zip(_TORSO, _UNREAL_TORSO, strict=True))
        for side in _SIDES:
            ending = f"_{side[0].lower()}"
            names |= {side + ours: theirs + ending for ours, theirs in zip(_LIMBS, _UNREAL_LIMBS, strict=True)}
            for finger in _FINGERS:
                names |= {f"{side}Hand{finger}{bone}": f"{finger.lower()}_0{bone}{ending}" for bone in (1, 2, 3)}
        return names
    bones = human_bones(_MIXAMO, "1.0" if rig == "vrm" else "0.x")
    return {_MIXAMO[index]: bone if rig == "vrm" else bone[0].upper() + bone[1:] for bone, index in bones.items()}


def _cmu_names() -> dict[str, tuple[str, ...]]:
    names: dict[str, tuple[str, ...]] = {name: (name,) for name in _MIXAMO}
    for ours, theirs in _CMU.items():
        for side in _SIDES if "{side}" in ours else ("",):
            names[ours.format(side=side)] = tuple(other.format(side=side) for other in theirs)
    return names


def _look_up(table: Mapping[str, tuple[str, ...]], index_of: Mapping[str, int]) -> dict[str, int]:
    found = {}
    for name, candidates in table.items():
        matches = [index_of[key] for key in map(_normalise, candidates) if key in index_of]
        if matches:
            found[name] = matches[0]
    return found


def _normalise(name: str) -> str:
    letters = "".join(character for character in name.split(":")[-1].lower() if character.isalnum())
    return letters.removeprefix("mixamorig")
