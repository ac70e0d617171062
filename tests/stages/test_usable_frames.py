"""What field, mesh and texture read of a capture where the fit failed in some frames."""

from importlib import import_module
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

from pipeline.body.files import save_motion
from pipeline.capture import capture
from pipeline.capture.capture import image_path
from pipeline.capture.usable_frames import SCORES_NPZ
from pipeline.io.npz import save_npz
from tests.field.scene import painted_scene
from tests.stages.painted_run import make_run

FRAMES = 14
HELD_OUT, WRECKED = {0, 8}, {0, 4, 5, 6}


class EnoughRead(Exception):
    """The stage has its pictures; the rest takes long and is tested elsewhere."""


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    scene = painted_scene(FRAMES, height_px=96)
    folders = make_run(
        tmp_path_factory.mktemp("run"), scene.body, scene.motion, scene.camera, scene.images, scene.masks
    )
    save_motion(folders["body"] / "motion.npz", scene.motion)
    save_npz(folders["body"] / SCORES_NPZ, {"usable": ~np.isin(np.arange(FRAMES), list(WRECKED))})
    return folders


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stage", "not_needed", "after_reading"),
    [
        ("field", ["create_trainer"], "train_field"),
        ("mesh", ["load_occupancy"], "pixel_footprint_m"),
        ("texture", [], "build_atlas"),
    ],
)
def test_no_stage_trains_or_decides_on_an_unusable_frame(
    inputs: dict[str, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    stage: str,
    not_needed: list[str],
    after_reading: str,
) -> None:
    read: set[int] = set()
    module = import_module(f"stages.{stage}")

    def noted(folder: Path, frame_index: int) -> Path:
        read.add(int(frame_index))
        return image_path(folder, frame_index)

    for reader in (capture, module):
        if hasattr(reader, "image_path"):
            monkeypatch.setattr(reader, "image_path", noted)
    for name in not_needed:
        monkeypatch.setattr(module, name, mock.Mock())
    monkeypatch.setattr(module, after_reading, mock.Mock(side_effect=EnoughRead))
    with pytest.raises(EnoughRead):
        module.STAGE.run(inputs, tmp_path, module.STAGE.config())
    assert read == set(range(FRAMES)) - HELD_OUT - WRECKED
