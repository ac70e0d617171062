"""The texture stage, killed and resumed: it repeats neither landmarks nor mean, and writes the files of a whole run."""

from pathlib import Path

import pytest

import pipeline.template.face.head_texture as head_texture
from pipeline.texture import bake
from stages import texture as texture_stage
from stages.texture import STAGE, run
from tests.field.scene import painted_scene
from tests.stages.painted_run import make_run

CONFIG = STAGE.config(max_texture_px=512, rounds=1)


class Killed(BaseException):
    """Ends a run like a signal: no code of the stage handles it."""


def kill(*_: object, **__: object) -> None:
    """Stand for a function in which, or in place of which, a run is killed."""
    raise Killed


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    scene = painted_scene(frames=20, height_px=160)
    folder = tmp_path_factory.mktemp("run")
    return make_run(folder, scene.body, scene.motion, scene.camera, scene.images, scene.masks)


def test_a_resumed_stage_writes_the_files_of_an_uninterrupted_one(
    inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed before the light is estimated, and in the rounds; what a checkpoint holds is not computed again."""
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    whole.mkdir()
    killed.mkdir()
    metrics = run(inputs, whole, CONFIG)
    with monkeypatch.context() as patch:
        patch.setattr(texture_stage, "find_light", kill)
        with pytest.raises(Killed):
            run(inputs, killed, CONFIG)
    with monkeypatch.context() as patch:
        patch.setattr(head_texture, "find_landmarks", kill)
        patch.setattr(bake, "average_residuals", kill)
        with pytest.raises(Killed):
            run(inputs, killed, CONFIG)
    assert (killed / texture_stage.TEXELS_CHECKPOINT).exists()
    with monkeypatch.context() as patch:
        patch.setattr(head_texture, "find_landmarks", kill)
        patch.setattr(bake, "average_views", kill)
        assert run(inputs, killed, CONFIG) == metrics
    for name in STAGE.makes:
        assert (killed / name).read_bytes() == (whole / name).read_bytes(), name
