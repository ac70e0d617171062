"""Field stage, killed and resumed: it writes the files of an uninterrupted run and reports the total time."""

import csv
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import pytest
import torch

from pipeline.body.files import save_motion
from pipeline.core.manifest import PROGRESS_FILE
from pipeline.field.trainer import Trainer
from pipeline.field.validation import Validator
from stages import field as field_stage
from stages.field import CHECKPOINT_FILE, STAGE, train_field
from tests.field.scene import field_config, painted_scene
from tests.stages.painted_run import make_run

TINY = field_config(
    device="cpu",
    steps=24,
    rays_per_step=512,
    frames_per_step=3,
    levels=3,
    log2_hashmap_size=12,
    min_clothing_offset_m=0.04,
    step_fraction=0.02,
    occupancy_update_interval=4,
    occupancy_warmup_steps=4,
    pose_start_fraction=0.2,
)


class Killed(BaseException):
    """Ends a run like a signal: no code of the stage handles it."""


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    scene = painted_scene(frames=12, height_px=96)
    inputs = make_run(tmp_path_factory.mktemp("run"), scene.body, scene.motion, scene.camera, scene.images, scene.masks)
    save_motion(inputs["body"] / "motion.npz", scene.motion)
    return inputs


@pytest.fixture(scope="module")
def whole(inputs: dict[str, Path]) -> tuple[Path, dict[str, float]]:
    """Folder and metrics of an uninterrupted run."""
    out = inputs["body"].parent / "whole"
    out.mkdir()
    return out, dict(STAGE.run(inputs, out, TINY))


@pytest.fixture(autouse=True)
def checkpoint_at_every_step(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(field_stage, "CHECKPOINT_INTERVAL_S", -1.0)


def curve(out: Path) -> list[dict[str, float]]:
    with (out / PROGRESS_FILE).open(newline="", encoding="utf-8") as file:
        return [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]


def killed_in(step: int, real_step):
    """A training step that is killed in step number `step`, counted from 1."""

    def step_or_die(trainer):
        if trainer.completed_steps == step - 1:
            raise Killed
        return real_step(trainer)

    return step_or_die


@pytest.mark.parametrize("step", [7, 24])
def test_a_resumed_stage_writes_the_files_of_an_uninterrupted_one(inputs, whole, tmp_path, monkeypatch, step):
    """Killed after the pose refinement started and before the occupancy update; killed in the last step."""
    uninterrupted, expected = whole
    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "step", killed_in(step, Trainer.step))
        with pytest.raises(Killed):
            STAGE.run(inputs, tmp_path, TINY)
    assert (tmp_path / CHECKPOINT_FILE).exists()
    steps_made = []
    with monkeypatch.context() as patch:
        real_step = Trainer.step
        patch.setattr(Trainer, "step", lambda self: (steps_made.append(self.completed_steps), real_step(self)))
        found = dict(STAGE.run(inputs, tmp_path, TINY))
    assert steps_made == list(range(step - 1, int(expected["steps"])))
    for name in STAGE.makes:
        assert (tmp_path / name).read_bytes() == (uninterrupted / name).read_bytes(), name
    timeless = expected.keys() - {"seconds_per_step"}
    assert {name: found[name] for name in timeless} == {name: expected[name] for name in timeless}
    assert [row | {"seconds": 0} for row in curve(tmp_path)] == [row | {"seconds": 0} for row in curve(uninterrupted)]


def known_trainer(clock: SimpleNamespace, kill_in: int | None = None) -> mock.MagicMock:
    """A trainer of 32 steps that take two seconds each on `clock`."""
    trainer = mock.MagicMock(spec=Trainer, completed_steps=0, refines_poses=True, config=field_config(steps=32))

    def step() -> None:
        if trainer.completed_steps + 1 == kill_in:
            raise Killed
        clock.now_s += 2.0
        trainer.completed_steps += 1

    def load(tensors: dict[str, torch.Tensor]) -> None:
        trainer.completed_steps = int(tensors["completed_steps"])

    trainer.step.side_effect, trainer.load_state_dict.side_effect = step, load
    trainer.state_dict.side_effect = lambda: {"completed_steps": torch.tensor(trainer.completed_steps)}
    return trainer


def test_the_training_time_continues_from_the_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Killed in step 11 and again in step 15; measurements follow steps 8, 12 and 16. Steps between measurement and
    checkpoint count, and repeated steps count once."""
    clock = SimpleNamespace(now_s=100.0)
    monkeypatch.setattr(field_stage, "time", SimpleNamespace(monotonic=lambda: clock.now_s))
    validator = mock.MagicMock(spec=Validator, ground_truth=[None])
    validator.subsampled.return_value = validator
    validator.mean_psnr_db.return_value, validator.psnr_per_frame_db.return_value = (30.0, 25.0), [29.0]
    for kill_in in (11, 15):
        with pytest.raises(Killed):
            train_field(known_trainer(clock, kill_in), validator, tmp_path)
    train_field(known_trainer(clock), validator, tmp_path)
    rows = curve(tmp_path)
    assert [row["step"] for row in rows] == [1, 2, 4, 8, 12, 16, 20, 24, 28, 32]
    assert [row["seconds"] for row in rows] == [2 * row["step"] for row in rows]
