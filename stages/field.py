"""field: train a canonical radiance field and refined poses on the training frames."""

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
from pipeline.capture.frame_selection import evenly_spaced
from pipeline.capture.masks.matting import resize_premultiplied
from pipeline.capture.usable_frames import usable_positions
from pipeline.core.cli import main
from pipeline.core.device import select_device
from pipeline.core.errors import UserError
from pipeline.core.measure import MIB
from pipeline.core.progress import track, warn
from pipeline.core.stage import Stage
from pipeline.field.checkpoint import CHECKPOINT_FILE, load_checkpoint, save_checkpoint
from pipeline.field.config import FieldConfig
from pipeline.field.field import RadianceField
from pipeline.field.files import save_field, save_occupancy
from pipeline.field.optimiser import DivergedError
from pipeline.field.setup import MaskedImage, create_trainer, training_scale
from pipeline.field.trainer import Trainer
from pipeline.field.validation import Validator
from pipeline.field.validation_curve import ValidationCurve
from pipeline.geometry.camera import Camera
from pipeline.io.image import read_gray, read_rgb, to_float, to_uint8, write_rgb

CHECKPOINT_INTERVAL_S = 15.0
PREVIEW_FILE, PREVIEW_FRAMES = "preview.png", 4
PSNR_DECIMALS = 2
"""Decimals (dB) to which the PSNR of fitted and of refined poses are compared."""
VALIDATION_FRACTIONS = (1 / 32, 1 / 15, 1 / 8, 1 / 4, 3 / 8, 1 / 2, 5 / 8, 3 / 4, 7 / 8, 1)
"""Fractions of the steps after which the validation PSNR is measured."""


def run(inputs: Mapping[str, Path], out: Path, config: FieldConfig) -> Mapping[str, float]:
    """Train the field, decide on validation frames whether to keep the refined poses, and write field, occupancy and
    motion.

    To change constants of the method from Python, pass `FieldConfig(settings=FieldSettings(...))`.
    """
    capture, camera = load_capture(inputs["frames"]), load_camera(inputs["body"] / "camera.npz")
    body, motion = load_body(inputs["body"] / "body.npz"), load_motion(inputs["body"] / "motion.npz")
    camera = camera.scaled(training_scale(body, motion, camera, config.max_person_px))
    train = usable_positions(capture, inputs["body"])
    train = train[evenly_spaced(len(train), config.max_frames)]
    masked_images = read_masked_images(capture, train, camera)
    device = select_device(config.device, "field.device")
    trainer = create_trainer(body, motion.select(train), camera, masked_images, config, device)
    validation = usable_positions(capture, inputs["body"], selection.VALIDATION)
    validator = build_validator(capture, validation, motion, camera, config)
    seconds_per_step = train_field(trainer, validator, out)
    motion, metrics, renders = select_poses(trainer, validator, motion)
    save_field(out / "field.safetensors", trainer.field)
    save_occupancy(out / "occupancy.npz", trainer.occupancy.binary())
    save_motion(out / "motion.npz", motion)
    write_preview(out / PREVIEW_FILE, renders, validator)
    return metrics | {
        "steps": trainer.completed_steps,
        "seconds_per_step": seconds_per_step,
        "samples_per_step": trainer.count_samples(),
        "occupied_cells": int(trainer.occupancy.occupied.sum()),
        "train_frames": len(train),
        "parameters": sum(parameter.numel() for parameter in trainer.field.parameters()),
        **finest_cell_metrics(trainer.field),
        **peak_gpu_memory_metrics(device),
    }


def finest_cell_metrics(field: RadianceField) -> dict[str, float]:
    """Return the edge of the finest cells of the hash grid, mm; empty for a field without a grid."""
    if not field.layout.cells_per_axis:
        return {}
    extent_m = (field.bounds_m[1] - field.bounds_m[0]).cpu().numpy()
    return {"finest_cell_mm": 1000.0 * float((extent_m / np.array(field.layout.cells_per_axis[-1])).max())}


def peak_gpu_memory_metrics(device: torch.device) -> dict[str, float]:
    """Return the peak memory of tensors on a CUDA GPU, MiB; empty for the CPU."""
    if device.type != "cuda":
        return {}
    return {"peak_gpu_mib": torch.cuda.max_memory_allocated(device) / MIB}


def read_masked_images(capture: Capture, positions: Int[np.ndarray, "k"], camera: Camera) -> list[MaskedImage]:
    """Read images and masks of frames (positions in the capture) at the size of the camera."""
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        masked_images = pool.map(partial(read_masked_image, capture, camera=camera), positions)
        return list(track(masked_images, "read frames", total=len(positions)))


def read_masked_image(capture: Capture, position: int | np.integer, camera: Camera) -> MaskedImage:
    """Read the image and the mask of one frame at the size of the camera."""
    index, size = capture.frame_index[position], (camera.width, camera.height)
    image, mask = read_rgb(image_path(capture.folder, index)), read_gray(mask_path(capture.folder, index))
    if (capture.width, capture.height) == size:
        return image, mask
    small, alpha = resize_premultiplied(to_float(image), to_float(mask), size)
    return to_uint8(small), to_uint8(alpha)


def build_validator(
    capture: Capture, positions: Int[np.ndarray, "k"], motion: Motion, camera: Camera, config: FieldConfig
) -> Validator:
    """Read at most `validation_frames` of these frames, evenly spaced."""
    positions = positions[evenly_spaced(len(positions), config.validation_frames)] if len(positions) else positions
    return Validator(motion.select(positions), camera, read_masked_images(capture, positions, camera))


def train_field(trainer: Trainer, validator: Validator, out: Path) -> float:
    """Take all remaining steps with regular checkpoints and small previews; return the median time of a step, s.

    Raises:
        UserError: the training diverged.
    """
    checkpoint = out / CHECKPOINT_FILE
    seconds_before = load_checkpoint(checkpoint, trainer)
    curve, subsampled_validator = ValidationCurve(out, trainer.completed_steps), validator.subsampled()
    validation_steps = {round(fraction * trainer.config.steps) for fraction in VALIDATION_FRACTIONS}
    step_seconds, last_save_s = [], time.monotonic()
    steps = range(trainer.completed_steps, trainer.config.steps)
    for _ in track(steps, "field", total=trainer.config.steps, initial=trainer.completed_steps):
        start_s = time.monotonic()
        try:
            trainer.step()
        except DivergedError as error:
            raise UserError(
                f"the training of the field diverged ({error}): look for damaged images or masks in the frames "
                "folder, or train with another random seed: --set field.seed=1"
            ) from None
        step_seconds.append(time.monotonic() - start_s)
        if trainer.completed_steps in validation_steps and validator.ground_truth:
            poses = subsampled_validator.pose_warps(trainer, trainer.refines_poses)
            renders = subsampled_validator.render(trainer, poses)
            curve.add(
                trainer.completed_steps,
                seconds_before + sum(step_seconds),
                *subsampled_validator.mean_psnr_db(renders),
                *subsampled_validator.psnr_per_frame_db(renders),
            )
            write_preview(out / PREVIEW_FILE, renders, subsampled_validator)
        if time.monotonic() - last_save_s > CHECKPOINT_INTERVAL_S:
            save_checkpoint(checkpoint, trainer, seconds_before + sum(step_seconds))
            last_save_s = time.monotonic()
    curve.finish()
    return float(np.median(step_seconds)) if step_seconds else 0.0


def select_poses(
    trainer: Trainer, validator: Validator, motion: Motion
) -> tuple[Motion, dict[str, float], list[np.ndarray]]:
    """Drop the pose corrections if they lower the validation PSNR; return motion, metrics and renders.

    The corrections are interpolated in time to the validation frames. Far from the training frames they are zero there,
    and the PSNR is equal; then they are kept, because the field was trained with them. Subsampled images decide
    (`validation_psnr_fitted_db`, `validation_psnr_refined_db`); the selected poses are rendered in full
    (`validation_psnr_db`, `validation_psnr_body_db`).
    """
    refines = trainer.config.pose_refinement
    if not validator.ground_truth:
        if refines:
            warn("the refined poses were dropped, because there are no validation frames to test them on")
        return motion, {"poses_kept": 0.0}, []
    subsampled_validator = validator.subsampled()
    candidates = {"fitted": False, "refined": True} if refines else {"fitted": False}
    pose_warps = {name: validator.pose_warps(trainer, refined) for name, refined in candidates.items()}
    metrics = {
        f"validation_psnr_{name}_db": subsampled_validator.mean_psnr_db(subsampled_validator.render(trainer, poses))[0]
        for name, poses in pose_warps.items()
    }
    best = max(reversed(candidates), key=lambda name: round(metrics[f"validation_psnr_{name}_db"], PSNR_DECIMALS))
    if refines and best == "fitted":
        warn("the refined poses were dropped, because they lower the PSNR of the validation frames")
    renders = validator.render(trainer, pose_warps[best])
    psnr_db, psnr_body_db = validator.mean_psnr_db(renders)
    metrics |= {"validation_psnr_db": psnr_db, "validation_psnr_body_db": psnr_body_db}
    selected_motion = trainer.poses.apply(motion) if candidates[best] else motion
    return selected_motion, metrics | {"poses_kept": float(candidates[best])}, renders


def write_preview(path: Path, renders: list[np.ndarray], validator: Validator) -> None:
    """Write validation frames in pairs: render (left) and image (right)."""
    pairs = [np.concatenate(pair, axis=1) for pair in zip(renders, validator.targets, strict=True)]
    if pairs:
        write_rgb(path, np.concatenate(pairs[:PREVIEW_FRAMES], axis=0))


STAGE = Stage(
    "field",
    version=20,
    needs=("frames", "body"),
    makes=("field.safetensors", "occupancy.npz", "motion.npz"),
    config=FieldConfig,
    run=run,
)

if __name__ == "__main__":
    raise SystemExit(main(STAGE))
