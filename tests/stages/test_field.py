"""Field stage: validation curve, all steps, and selection of poses. tests/test_all.py runs the whole stage."""

import csv
from dataclasses import dataclass, field, replace
from unittest import mock

import numpy as np
import pytest

from pipeline.body.body import Motion
from pipeline.body.pose_correction import PoseCorrection
from pipeline.capture.capture import Capture, image_path, mask_path
from pipeline.core.progress import take_warnings
from pipeline.field.config import FieldConfig
from pipeline.field.trainer import Trainer
from pipeline.field.validation import Validator
from pipeline.field.validation_curve import ValidationCurve
from pipeline.geometry.camera import Camera
from pipeline.io.image import write_gray, write_rgb
from stages.field import read_masked_images, select_poses, train_field


def rows_of(path):
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_the_curve_resumes_at_the_checkpoint(tmp_path):
    first = ValidationCurve(tmp_path, completed_steps=0)
    first.add(10, 1.5, 20.0, 15.0)
    first.add(20, 3.0, 22.0, 16.0)
    # Killed after step 20; the checkpoint is of step 15, so that step 20 is repeated.
    second = ValidationCurve(tmp_path, completed_steps=15)
    second.add(20, 2.2, 22.5, 16.5)
    second.add(40, 5.5, 24.0, 18.0)
    second.finish()
    rows = rows_of(tmp_path / "progress.csv")
    assert [float(row["step"]) for row in rows] == [10, 20, 40]
    assert [float(row["seconds"]) for row in rows] == [1.5, 2.2, 5.5]
    assert [float(row["validation_psnr_db"]) for row in rows] == [20.0, 22.5, 24.0]
    # Killed before the stage was done: only checkpoint files remain.
    (tmp_path / "progress.csv").unlink()
    ValidationCurve(tmp_path, completed_steps=40).finish()
    assert rows_of(tmp_path / "progress.csv") == rows


def test_without_rows_there_is_no_file(tmp_path):
    ValidationCurve(tmp_path, completed_steps=0).finish()
    assert not list(tmp_path.iterdir())


def test_a_restored_curve_keeps_the_scores_of_each_frame(tmp_path):
    first = ValidationCurve(tmp_path, completed_steps=0)
    first.add(100, 1.0, 29.0, 0.0, 30.0, 28.0)
    restored = ValidationCurve(tmp_path, completed_steps=100)
    restored.add(200, 2.0, 29.0, 0.0, 30.1, 27.9)
    rows = rows_of(tmp_path / "checkpoint_progress.csv")
    assert [[float(row[f"frame_{frame}_db"]) for frame in range(2)] for row in rows] == [[30.0, 28.0], [30.1, 27.9]]


def test_training_takes_all_steps_also_where_validation_frames_gain_nothing(tmp_path):
    """The learning rate falls until the last step: the last eighth gains most where the one before gained nothing."""
    trainer = mock.MagicMock(spec=Trainer, completed_steps=0, refines_poses=True, config=FieldConfig(steps=32))

    has_preview = []

    def step():
        has_preview.append((tmp_path / "preview.png").exists())
        trainer.completed_steps += 1

    trainer.step.side_effect = step
    picture = np.zeros((4, 3, 3), np.uint8)
    validator = mock.MagicMock(spec=Validator, ground_truth=[None, None], targets=[picture, picture])
    validator.render.return_value = [picture, picture]
    validator.subsampled.return_value = validator
    validator.mean_psnr_db.return_value, validator.psnr_per_frame_db.return_value = (30.0, 25.0), [29.0, 31.0]
    train_field(trainer, validator, tmp_path)
    assert trainer.completed_steps == 32
    assert has_preview == [False] + 31 * [True]
    assert [float(row["step"]) for row in rows_of(tmp_path / "progress.csv")][-1] == 32


FITTED = Motion(np.arange(4), np.arange(4) / 10, np.tile([1.0, 0.0, 0.0, 0.0], (4, 1, 1)), np.zeros((4, 3)))
REFINED = FITTED.with_pose(FITTED.rotations_wxyz, FITTED.root_translation_m + 0.01)


@dataclass(frozen=True)
class KnownValidator(Validator):
    """Renders are darker than the images by known levels, for fitted and for refined poses.

    requests: for each render, whether images are subsampled, and whether poses are refined.
    """

    levels: tuple[int, int] = (0, 0)
    is_subsampled: bool = False
    requests: list[tuple[bool, bool]] = field(default_factory=list)

    def subsampled(self) -> "KnownValidator":
        return replace(self, is_subsampled=True)

    def pose_warps(self, trainer: Trainer, refined: bool) -> bool:
        return refined

    def render(self, trainer: Trainer, poses: bool) -> list[np.ndarray]:
        self.requests.append((self.is_subsampled, poses))
        return [target - np.uint8(self.levels[poses]) for target in self.targets]


def known_validator(levels: tuple[int, int], frames: int) -> KnownValidator:
    truth = np.full((8, 6, 3), 200, np.uint8), np.full((8, 6), 255, np.uint8)
    return KnownValidator(FITTED.select(np.arange(frames)), Camera(9.0, 9.0, 3.0, 4.0, 6, 8), [truth] * frames, levels)


def known_trainer(refines: bool) -> Trainer:
    poses = mock.MagicMock(spec=PoseCorrection)
    poses.apply.return_value = REFINED
    return mock.MagicMock(spec=Trainer, config=FieldConfig(pose_refinement=refines), poses=poses)


def selected(levels: tuple[int, int], frames: int = 2, refines: bool = True):
    """Results of `select_poses` on grey images, and its warnings."""
    trainer, validator = known_trainer(refines), known_validator(levels, frames)
    take_warnings()
    return *select_poses(trainer, validator, FITTED), take_warnings()


def decibels(levels: int) -> float:
    return 20 * np.log10(255 / levels)


def test_refined_poses_are_kept_if_the_psnr_rises():
    kept, metrics, renders, warnings = selected((10, 5))
    assert kept is REFINED
    assert warnings == []
    assert metrics == pytest.approx(
        {
            "validation_psnr_fitted_db": decibels(10),
            "validation_psnr_refined_db": decibels(5),
            "validation_psnr_db": decibels(5),
            "validation_psnr_body_db": decibels(5),
            "poses_kept": 1.0,
        }
    )
    assert [int(image[0, 0, 0]) for image in renders] == [195, 195]


def test_refined_poses_are_kept_if_validation_frames_cannot_tell():
    """Far from the training frames corrections are zero: both renders are equal."""
    kept, metrics, _, warnings = selected((5, 5))
    assert kept is REFINED
    assert warnings == []
    assert metrics["poses_kept"] == 1.0


def test_refined_poses_are_dropped_if_they_lower_the_psnr():
    levels = (5, 10)
    kept, metrics, renders, (warning,) = selected(levels)
    assert kept is FITTED
    assert warning == "the refined poses were dropped, because they lower the PSNR of the validation frames"
    assert metrics["validation_psnr_db"] == metrics["validation_psnr_fitted_db"] == pytest.approx(decibels(5))
    assert metrics["validation_psnr_refined_db"] == pytest.approx(decibels(levels[1]))
    assert metrics["poses_kept"] == 0.0
    assert int(renders[0][0, 0, 0]) == 195


@pytest.mark.parametrize(("levels", "is_better"), [((10, 5), True), ((5, 10), False)])
def test_only_the_selected_poses_are_rendered_in_full(levels, is_better):
    validator = known_validator(levels, 2)
    select_poses(known_trainer(refines=True), validator, FITTED)
    assert validator.requests == [(True, False), (True, True), (False, is_better)]


def test_refined_poses_are_dropped_without_validation_frames():
    kept, metrics, renders, (warning,) = selected((10, 5), frames=0)
    assert kept is FITTED
    assert metrics == {"poses_kept": 0.0}
    assert renders == []
    assert "no validation frames" in warning


@pytest.mark.parametrize("frames", [0, 2])
def test_fitted_poses_are_kept_without_a_warning(frames):
    kept, metrics, _, warnings = selected((10, 5), frames, refines=False)
    assert kept is FITTED
    assert warnings == []
    assert "validation_psnr_refined_db" not in metrics


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_images_are_read_in_order_at_the_size_of_the_camera(tmp_path, scale):
    indices = np.array([30, 10, 20])
    for index in indices:
        image_path(tmp_path, index).parent.mkdir(exist_ok=True)
        mask_path(tmp_path, index).parent.mkdir(exist_ok=True)
        write_rgb(image_path(tmp_path, index), np.full((8, 6, 3), index, np.uint8))
        write_gray(mask_path(tmp_path, index), np.full((8, 6), 255, np.uint8))
    capture = mock.MagicMock(spec=Capture, folder=tmp_path, frame_index=indices, width=6, height=8)
    camera = Camera(9.0, 9.0, 3.0, 4.0, 6, 8).scaled(scale)
    masked_images = read_masked_images(capture, np.array([2, 0, 1]), camera)
    assert [image.shape for image, _ in masked_images] == [(camera.height, camera.width, 3)] * 3
    assert [int(image[0, 0, 0]) for image, _ in masked_images] == [20, 30, 10]
    assert all((mask == 255).all() for _, mask in masked_images)
