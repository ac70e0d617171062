"""field: the instant avatar, a radiance field in the canonical A-pose, learnt from the frames in about a minute."""

import csv
import math
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Int

from pipeline.body.body import Motion
from pipeline.body.files import load_body, load_camera, load_motion, save_motion
from pipeline.capture import frame_selection as selection
from pipeline.capture.capture import Capture, image_path, load_capture, mask_path
from pipeline.capture.matting import resize_premultiplied
from pipeline.capture.usable_frames import usable_training_positions
from pipeline.core.cli import main
from pipeline.core.device import select_device
from pipeline.core.errors import UserError
from pipeline.core.manifest import PROGRESS_FILE
from pipeline.core.measure import MIB
from pipeline.core.progress import track, warn
from pipeline.core.stage import Stage
from pipeline.field.config import FieldConfig
from pipeline.field.files import save_field, save_occupancy
from pipeline.field.setup import MaskedImage, create_trainer, evenly_spaced, training_scale
from pipeline.field.trainer import DivergedError, Trainer
from pipeline.field.validation import Validator
from pipeline.geometry.camera import Camera
from pipeline.io.image import read_gray, read_rgb, to_float, to_uint8, write_rgb
from pipeline.io.tensors import load_tensors, save_tensors

CHECKPOINT, CHECKPOINT_EVERY_S = "checkpoint.safetensors", 15.0
PREVIEW_FRAMES = 4
VALIDATION_FRACTIONS = (1 / 32, 1 / 16, 1 / 8, 1 / 4, 3 / 8, 1 / 2, 5 / 8, 3 / 4, 7 / 8, 1)
"""Parts of the steps after which the field is scored on validation frames, for the curve of accuracy over time."""


def run(inputs: Mapping[str, Path], out: Path, config: FieldConfig) -> Mapping[str, float]:
    """Learn the field on training frames, judge the refined poses on validation frames, write field, occupancy,
    motion.
    """
    capture, camera = load_capture(inputs["frames"]), load_camera(inputs["body"] / "camera.npz")
    body, motion = load_body(inputs["body"] / "body.npz"), load_motion(inputs["body"] / "motion.npz")
    camera = camera.scaled(training_scale(body, motion, camera, config.max_person_px))
    train = usable_training_positions(capture, inputs["body"])
    train = train[evenly_spaced(len(train), config.max_frames)]
    masked_images = read_masked_images(capture, train, camera)
    device = select_device(config.device, "field.device")
    trainer = create_trainer(body, motion.select(train), camera, masked_images, config, device)
    validator = build_validator(capture, motion, camera, config)
    seconds_per_step = train_field(trainer, validator, out)
    motion, metrics, renders = select_poses(trainer, validator, motion)
    save_field(out / "field.safetensors", trainer.field)
    save_occupancy(out / "occupancy.npz", trainer.occupancy.grid())
    save_motion(out / "motion.npz", motion)
    write_preview(out / "preview.png", renders, validator)
    return metrics | {
        "steps": trainer.completed_steps,
        "seconds_per_step": seconds_per_step,
        "occupied_cells": int(trainer.occupancy.occupied.sum()),
        "train_frames": len(train),
        "parameters": sum(parameter.numel() for parameter in trainer.field.parameters()),
        **peak_gpu_memory_metrics(device),
    }


def peak_gpu_memory_metrics(device: torch.device) -> dict[str, float]:
    """The most memory that tensors took on a graphics card, MiB; nothing where none was used."""
    if device.type != "cuda":
        return {}
    return {"peak_gpu_mib": torch.cuda.max_memory_allocated(device) / MIB}


def read_masked_images(capture: Capture, positions: Int[np.ndarray, "k"], camera: Camera) -> list[MaskedImage]:
    """Image and mask of these frames at the camera's size."""
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        masked_images = pool.map(partial(read_masked_image, capture, camera=camera), positions)
        return list(track(masked_images, "read frames", total=len(positions)))


def read_masked_image(capture: Capture, position: int | np.integer, camera: Camera) -> MaskedImage:
    """Image and mask of a frame at the camera's size, uint8."""
    index, size = capture.frame_index[position], (camera.width, camera.height)
    image, mask = read_rgb(image_path(capture.folder, index)), read_gray(mask_path(capture.folder, index))
    if (capture.width, capture.height) == size:
        return image, mask
    small, alpha = resize_premultiplied(to_float(image), to_float(mask), size)
    return to_uint8(small), to_uint8(alpha)


def build_validator(capture: Capture, motion: Motion, camera: Camera, config: FieldConfig) -> Validator:
    """Some of the validation frames, evenly spread."""
    chosen = capture.positions(selection.VALIDATION)
    chosen = chosen[evenly_spaced(len(chosen), config.validation_frames)] if len(chosen) else chosen
    return Validator(motion.select(chosen), camera, read_masked_images(capture, chosen, camera))


def train_field(trainer: Trainer, validator: Validator, out: Path) -> float:
    """All steps that are still to do, with a checkpoint now and then; returns the median seconds of a step."""
    checkpoint, before_s = out / CHECKPOINT, 0.0
    if checkpoint.exists():
        tensors, description = load_tensors(checkpoint)
        trainer.load_state(tensors)
        before_s = float(description["seconds"])
    progress, subsampled_validator = ValidationCurve(out, trainer.completed_steps), validator.subsampled()
    validation_steps = {round(fraction * trainer.config.steps) for fraction in VALIDATION_FRACTIONS}
    seconds, saved = [], time.monotonic()
    steps = range(trainer.completed_steps, trainer.config.steps)
    for _ in track(steps, "field", total=trainer.config.steps, initial=trainer.completed_steps):
        start = time.monotonic()
        try:
            trainer.step()
        except DivergedError as error:
            raise UserError(
                f"the field does not learn ({error}); lower field.table_learning_rate and try again"
            ) from None
        seconds.append(time.monotonic() - start)
        if trainer.completed_steps in validation_steps and validator.ground_truth:
            renders = subsampled_validator.render(trainer, subsampled_validator.pose(trainer, trainer.refines_poses))
            progress.add(
                trainer.completed_steps,
                before_s + sum(seconds),
                *subsampled_validator.score(renders),
                *subsampled_validator.psnr_per_frame_db(renders),
            )
            if trainer.config.early_stop and progress.has_converged(trainer.config.steps / 2):
                break
        if time.monotonic() - saved > CHECKPOINT_EVERY_S:
            save_tensors(checkpoint, trainer.state(), {"seconds": before_s + sum(seconds)})
            saved = time.monotonic()
    progress.finish()
    return float(np.median(seconds)) if seconds else 0.0


class ValidationCurve:
    """The curve of accuracy over time, kept beside the checkpoint and published as `progress.csv`.

    A row has step, seconds, the two mean scores, and then the score of each validation frame.
    """

    COLUMNS = ("step", "seconds", "validation_psnr_db", "validation_psnr_body_db")

    def __init__(self, out: Path, completed_steps: int) -> None:
        """Go on after the rows of the steps that a checkpoint holds."""
        self.kept, self.output_path = out / f"checkpoint_{PROGRESS_FILE}", out / PROGRESS_FILE
        self.rows: list[tuple[float, ...]] = []
        if self.kept.exists():
            with self.kept.open(newline="", encoding="utf-8") as file:
                rows = [tuple(float(value) for value in row) for row in list(csv.reader(file))[1:]]
            self.rows = [row for row in rows if row[0] <= completed_steps]

    def add(self, step: int, seconds: float, *scores_db: float) -> None:
        """Note the scores after a step, and the seconds of learning that led there."""
        self.rows.append((step, round(seconds, 3), *(round(score, 4) for score in scores_db)))
        frames = range(len(self.rows[0]) - len(self.COLUMNS))
        with self.kept.open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows([(*self.COLUMNS, *(f"frame_{frame}_db" for frame in frames)), *self.rows])

    def has_converged(self, first_step: float) -> bool:
        """True if neither of the last two looks, both after `first_step`, found a gain that stands out from its noise.

        The noise is the standard error of the mean over frames, each compared with itself a look before.
        """
        late = [row[len(self.COLUMNS) :] for row in self.rows if row[0] >= first_step]
        if len(late) < 3 or len(late[0]) < 2:
            return False
        gains_db = np.diff(np.array(late[-3:]), axis=0)
        noise_db = gains_db.std(axis=1, ddof=1) / math.sqrt(gains_db.shape[1])
        return bool((gains_db.mean(axis=1) <= noise_db).all())

    def finish(self) -> None:
        """Publish what there is."""
        if self.rows:
            self.kept.replace(self.output_path)


def select_poses(
    trainer: Trainer, validator: Validator, motion: Motion
) -> tuple[Motion, dict[str, float], list[np.ndarray]]:
    """Keep the pose corrections only if they make validation frames better, to which they come by interpolation in
    time. Thinned pictures decide (`psnr_fitted`, `psnr_refined`); what is kept is rendered whole (`psnr`, `psnr_body`).
    """
    refines = trainer.config.pose_refinement
    if not validator.ground_truth:
        if refines:
            warn("the refined poses have no validation frames to prove them and were dropped")
        return motion, {"poses_kept": 0.0}, []
    subsampled_validator, candidates = (
        validator.subsampled(),
        {"fitted": False} | ({"refined": True} if refines else {}),
    )
    poses = {name: validator.pose(trainer, refined) for name, refined in candidates.items()}
    scores = {
        f"psnr_{name}": subsampled_validator.score(subsampled_validator.render(trainer, there))[0]
        for name, there in poses.items()
    }
    best = max(candidates, key=lambda name: scores[f"psnr_{name}"])
    if refines and best == "fitted":
        warn("the refined poses did not make validation frames better and were dropped")
    renders = validator.render(trainer, poses[best])
    psnr, psnr_body = validator.score(renders)
    kept = trainer.poses.corrected(motion) if candidates[best] else motion
    return kept, scores | {"psnr": psnr, "psnr_body": psnr_body, "poses_kept": float(candidates[best])}, renders


def write_preview(path: Path, renders: list[np.ndarray], validator: Validator) -> None:
    """Validation frames in pairs: the field's render beside the truth."""
    pairs = [np.concatenate(pair, axis=1) for pair in zip(renders, validator.targets, strict=True)]
    if pairs:
        write_rgb(path, np.concatenate(pairs[:PREVIEW_FRAMES], axis=0))


STAGE = Stage(
    "field",
    version=14,
    needs=("frames", "body"),
    makes=("field.safetensors", "occupancy.npz", "motion.npz"),
    config=FieldConfig,
    run=run,
)

if __name__ == "__main__":
    raise SystemExit(main(STAGE))
