"""Blender's own importer opens the .glb: an upright skinned mesh that moves as the file says."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.avatar.gltf import write_glb
from tests.avatar.test_gltf import FRAMES, Player, encoded
from tests.tools.blender import inspect_in_blender


@pytest.mark.slow
def test_blender_opens_it_upright_and_moving(tmp_path: Path) -> None:
    path = tmp_path / "avatar.glb"
    write_glb(path, encoded())
    seconds = float(FRAMES[4]) / 25.0
    found = inspect_in_blender(path, tmp_path / "picture.png", seconds)
    assert (found["armatures"], found["skinned_meshes"], found["actions"]) == (1, 1, ["capture"])
    assert found["bones"] == 3
    posed = Player(path).posed_vertices(seconds)
    # Blender has +Z up and -Y in front; it plays at 24 frames a second, so the time is off by up to 1/48 s
    expected = np.stack([posed[:, 0], -posed[:, 2], posed[:, 1]], axis=1)
    np.testing.assert_allclose(found["low_m"], expected.min(axis=0), atol=0.04)
    np.testing.assert_allclose(found["high_m"], expected.max(axis=0), atol=0.04)
    assert (tmp_path / "picture.png").stat().st_size > 0
