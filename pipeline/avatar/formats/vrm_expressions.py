"""The expressions of VRM, made of the avatar's morph targets.

References: https://github.com/vrm-c/vrm-specification, VRMC_vrm-1.0/expressions.md and 0.0 (blendShapeMaster).
"""

from collections.abc import Mapping, Sequence
from typing import Any

from pipeline.io.glb import GlbFile

_SMILE = {"mouthSmileLeft": 0.8, "mouthSmileRight": 0.8}
_BLINK_LEFT, _BLINK_RIGHT = {"eyeBlinkLeft": 1.0}, {"eyeBlinkRight": 1.0}

EXPRESSIONS: Mapping[str, tuple[str, Mapping[str, float]]] = {
    "neutral": ("neutral", {}),
    "aa": ("a", {"viseme_aa": 1.0}),
    "ih": ("i", {"viseme_I": 1.0}),
    "ou": ("u", {"viseme_U": 1.0}),
    "ee": ("e", {"viseme_E": 1.0}),
    "oh": ("o", {"viseme_O": 1.0}),
    "blink": ("blink", _BLINK_LEFT | _BLINK_RIGHT),
    "blinkLeft": ("blink_l", _BLINK_LEFT),
    "blinkRight": ("blink_r", _BLINK_RIGHT),
    "lookUp": ("lookup", {"eyeLookUpLeft": 1.0, "eyeLookUpRight": 1.0}),
    "lookDown": ("lookdown", {"eyeLookDownLeft": 1.0, "eyeLookDownRight": 1.0}),
    "lookLeft": ("lookleft", {"eyeLookOutLeft": 1.0, "eyeLookInRight": 1.0}),
    "lookRight": ("lookright", {"eyeLookInLeft": 1.0, "eyeLookOutRight": 1.0}),
    "happy": ("joy", _SMILE | {"cheekSquintLeft": 0.5, "cheekSquintRight": 0.5}),
    "angry": ("angry", {"browDownLeft": 1.0, "browDownRight": 1.0, "mouthFrownLeft": 0.4, "mouthFrownRight": 0.4}),
    "sad": ("sorrow", {"browInnerUp": 0.8, "mouthFrownLeft": 0.7, "mouthFrownRight": 0.7}),
    "relaxed": ("fun", {"eyeSquintLeft": 0.4, "eyeSquintRight": 0.4, "mouthSmileLeft": 0.4, "mouthSmileRight": 0.4}),
    "surprised": (
        "unknown",
        {"browInnerUp": 0.7, "browOuterUpLeft": 0.7, "browOuterUpRight": 0.7, "eyeWideLeft": 0.7, "eyeWideRight": 0.7}
        | {"jawOpen": 0.2},
    ),
}
"""VRM 1.0's presets, with VRM 0.x's name of each, and the weights of the morph targets."""

_USED_MORPHS = frozenset(name for _, weights in EXPRESSIONS.values() for name in weights)

GAZE_FULL_DEG = 30.0
"""Angle of the gaze at which an expression of looking has its full weight."""


def morph_names(file: GlbFile) -> list[str]:
    """Return the names of the morph targets of the first mesh; empty if it lacks one that `EXPRESSIONS` use.

    An avatar without a moving face may have others: those of its shape.
    """
    names: list[str] = file.gltf["meshes"][0].get("extras", {}).get("targetNames", [])
    return names if _USED_MORPHS.issubset(names) else []


def expressions_vrm1(names: Sequence[str], node: int) -> dict[str, Any]:
    """Return the presets of VRM 1.0 for the morph targets of a node; empty without morph targets."""
    if not names:
        return {}
    return {
        preset: {
            "morphTargetBinds": [
                {"node": node, "index": names.index(name), "weight": weight} for name, weight in weights.items()
            ]
        }
        for preset, (_, weights) in EXPRESSIONS.items()
    }


def groups_vrm0(names: Sequence[str], mesh: int) -> list[dict[str, Any]]:
    """Return the blend shape groups of VRM 0.x for the morph targets of a mesh; empty without morph targets."""
    if not names:
        return []
    return [
        {
            "name": preset,
            "presetName": old,
            "binds": [
                {"mesh": mesh, "index": names.index(name), "weight": 100.0 * weight} for name, weight in weights.items()
            ],
            "materialValues": [],
            "isBinary": False,
        }
        for preset, (old, weights) in EXPRESSIONS.items()
    ]


def gaze_range_vrm1() -> dict[str, float]:
    """Return the map from the angle of the gaze to the weight of an expression."""
    return {"inputMaxValue": GAZE_FULL_DEG, "outputScale": 1.0}
