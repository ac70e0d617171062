"""Blender's importer reads the .glb: an upright skinned mesh that moves as the file specifies."""

from pathlib import Path

import numpy as np
import pytest

from tests.avatar.test_gltf import FRAMES, Player, encoded
from tests.tools.blender import inspect_in_blender


@pytest.mark.slow
def test_blender_imports_it_upright_and_animated(tmp_path: Path) -> None:
    path = tmp_path / "avatar.glb"
    path.write_bytes(encoded())
    seconds = float(FRAMES[4]) / 25.0
    found = inspect_in_blender(path, tmp_path / "picture.png", seconds)
    assert (found["armatures"], found["skinned_meshes"], found["actions"]) == (1, 1, ["capture"])
    assert found["bones"] == 3
    posed = Player(path).posed_vertices(seconds)
    # Blender: +Z up, -Y front; it plays at 24 frames per second, so the time is wrong by up to 1/48 s
    expected = np.stack([posed[:, 0], -posed[:, 2], posed[:, 1]], axis=1)
    np.testing.assert_allclose(found["low_m"], expected.min(axis=0), atol=0.04)
    np.testing.assert_allclose(found["high_m"], expected.max(axis=0), atol=0.04)
    assert (tmp_path / "picture.png").stat().st_size > 0
