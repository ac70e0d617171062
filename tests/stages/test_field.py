"""Field stage: validation curve, early stop, and selection of poses. tests/test_all.py runs the whole stage."""

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
    assert [path.name for path in tmp_path.iterdir()] == ["progress.csv"]


def test_without_rows_there_is_no_file(tmp_path):
    ValidationCurve(tmp_path, completed_steps=0).finish()
    assert not list(tmp_path.iterdir())


def curve(folder, *measurements):
    """A curve with a row every 100 steps; each measurement is the PSNR of every frame."""
    progress = ValidationCurve(folder, completed_steps=0)
    for index, frames in enumerate(measurements):
        progress.add(100 * (index + 1), float(index), float(np.mean(frames)), 0.0, *frames)
    return progress


def test_a_curve_has_converged_after_two_gains_below_the_noise(tmp_path):
    flat = [30.0, 28.0, 31.0], [30.1, 27.9, 31.0], [30.0, 28.05, 30.95]
    assert curve(tmp_path, *flat).has_converged(100.0)
    assert not curve(tmp_path, *flat).has_converged(200.0)
    assert not curve(tmp_path, *flat[:2]).has_converged(0.0)
    # Small gains of every frame; one large gain of two.
    assert not curve(tmp_path, *flat[:2], [30.13, 27.94, 31.03]).has_converged(0.0)
    assert not curve(tmp_path, [29.0, 27.0, 30.0], *flat[:2]).has_converged(0.0)
    # A loss is no gain.
    assert curve(tmp_path, *flat[:2], [29.5, 27.5, 30.5]).has_converged(0.0)
    # Standard error of a sample: 0.1 dB is less than 0.19 / sqrt(3).
    assert curve(tmp_path, [30.0, 28.0, 31.0], [30.29, 27.91, 31.1], [30.58, 27.82, 31.2]).has_converged(0.0)
    # One frame gives no estimate of the noise.
    assert not curve(tmp_path, [30.0], [30.0], [30.0]).has_converged(0.0)


def test_a_restored_curve_has_converged_too(tmp_path):
    measurements = [30.0, 28.0], [30.1, 27.9], [30.0, 28.05]
    curve(tmp_path, *measurements)
    assert ValidationCurve(tmp_path, completed_steps=300).has_converged(100.0)
    rows = rows_of(tmp_path / "checkpoint_progress.csv")
    assert [float(rows[1][f"frame_{frame}_db"]) for frame in range(2)] == [30.1, 27.9]


@pytest.mark.parametrize(("early_stop", "steps"), [(True, 24), (False, 32)])
def test_training_ends_once_it_has_converged(tmp_path, early_stop, steps):
    trainer = mock.MagicMock(
        spec=Trainer, completed_steps=0, refines_poses=True, config=FieldConfig(steps=32, early_stop=early_stop)
    )

    def step():
        trainer.completed_steps += 1

    trainer.step.side_effect = step
    validator = mock.MagicMock(spec=Validator, ground_truth=[None, None])
    validator.subsampled.return_value = validator
    validator.mean_psnr_db.return_value, validator.psnr_per_frame_db.return_value = (30.0, 25.0), [29.0, 31.0]
    train_field(trainer, validator, tmp_path)
    # Measurements after 4/8, 5/8 and 6/8 of the steps: two gains of zero.
    assert trainer.completed_steps == steps
    assert [float(row["step"]) for row in rows_of(tmp_path / "progress.csv")][-1] == steps


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
