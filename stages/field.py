"""field: the instant avatar, a radiance field in the canonical A-pose, learnt from the frames in half a minute."""

import time
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
import torch

from pipeline.avatar import selection
from pipeline.avatar.body import Body, Motion, canonical_to_world
from pipeline.avatar.field_config import FieldConfig
from pipeline.avatar.prepare import Picture, spread, start_learning, training_scale
from pipeline.avatar.render import render_field
from pipeline.avatar.train import DivergedError, Learning
from pipeline.core.cli import main
from pipeline.core.errors import UserError
from pipeline.core.progress import track, warn
from pipeline.core.stage import Stage
from pipeline.geometry.camera import Camera
from pipeline.io.capture import Capture, load_capture
from pipeline.io.checkpoint import load_tensors, save_field, save_occupancy, save_tensors
from pipeline.io.image import to_uint8, write_rgb
from pipeline.io.npz import load_body, load_camera, load_motion, save_motion
from pipeline.metrics.images import body_pixels, on_white, premultiplied_on_white, psnr_db

CHECKPOINT, CHECKPOINT_EVERY_S = "checkpoint.safetensors", 15.0
PREVIEW_FRAMES = 4


def run(inputs: Mapping[str, Path], out: Path, config: FieldConfig) -> Mapping[str, float]:
    """Learn the field on training frames, judge the refined poses on validation frames, write field, occupancy,
    motion.
    """
    for kind in (np.float32, np.float64):
        np.finfo(kind)  # Asked for the first time with denormals off, numpy would warn.
    torch.set_flush_denormal(True)
    capture, camera = load_capture(inputs["frames"]), load_camera(inputs["body"] / "camera.npz")
    body, motion = load_body(inputs["body"] / "body.npz"), load_motion(inputs["body"] / "motion.npz")
    camera = camera.scaled(training_scale(body, motion, camera, config.max_person_px))
    train = capture.positions(selection.TRAIN)
    train = train[spread(len(train), config.max_frames)]
    pictures = [read_picture(capture, position, camera) for position in track(train, "read frames")]
    learning = start_learning(body, motion.select(train), camera, pictures, config)
    seconds_per_step = learn(learning, out / CHECKPOINT)
    chosen = capture.positions(selection.VALIDATION)
    chosen = chosen[spread(len(chosen), config.validation_frames)] if len(chosen) else chosen
    truths = [read_picture(capture, position, camera) for position in chosen]
    motion, metrics, renders = judge_poses(learning, body, motion, camera, chosen, truths)
    save_field(out / "field.safetensors", learning.field)
    save_occupancy(out / "occupancy.npz", learning.occupancy.grid())
    save_motion(out / "motion.npz", motion)
    write_preview(out / "preview.png", renders, truths)
    return metrics | {
        "steps": learning.done,
        "seconds_per_step": seconds_per_step,
        "occupied_cells": int(learning.occupancy.occupied.sum()),
        "train_frames": len(train),
        "parameters": sum(parameter.numel() for parameter in learning.field.parameters()),
    }


def read_picture(capture: Capture, position: int, camera: Camera) -> Picture:
    """Image and mask of a frame at the camera's size, uint8."""
    size = (camera.width, camera.height)
    image, mask = capture.image(int(position)), capture.mask(int(position))
    if (capture.width, capture.height) != size:
        image, mask = (cv2.resize(array, size, interpolation=cv2.INTER_AREA) for array in (image, mask))
    return to_uint8(image), to_uint8(mask)


def learn(learning: Learning, checkpoint: Path) -> float:
    """All steps that are still to do, with a checkpoint now and then; returns the median seconds of a step."""
    if checkpoint.exists():
        learning.load_state(load_tensors(checkpoint)[0])
    seconds, saved = [], time.monotonic()
    steps = range(learning.done, learning.config.steps)
    for _ in track(steps, "field", total=learning.config.steps, initial=learning.done):
        start = time.monotonic()
        try:
            learning.step()
        except DivergedError as error:
            raise UserError(f"the field does not learn ({error}); lower field.table_rate and try again") from None
        seconds.append(time.monotonic() - start)
        if time.monotonic() - saved > CHECKPOINT_EVERY_S:
            save_tensors(checkpoint, learning.state())
            saved = time.monotonic()
    return float(np.median(seconds)) if seconds else 0.0


def judge_poses(
    learning: Learning, body: Body, motion: Motion, camera: Camera, positions: np.ndarray, truths: list[Picture]
) -> tuple[Motion, dict[str, float], list[np.ndarray]]:
    """Keep the pose corrections only if they make validation frames better, to which they come by interpolation in
    time.
    """
    motions = {"fitted": motion}
    if learning.config.pose_refinement:
        motions["refined"] = learning.poses.corrected(motion)
    shown = {name: render_frames(learning, body, one, camera, positions) for name, one in motions.items()}
    errors = {name: mean_psnr(renders, truths) for name, renders in shown.items()}
    best = max(errors, key=lambda name: errors[name][0]) if truths else list(motions)[-1]
    if best == "fitted" and learning.config.pose_refinement:
        warn("the refined poses did not make validation frames better and were dropped")
    metrics = {f"psnr_{name}": error[0] for name, error in errors.items()} if truths else {}
    if truths:
        metrics |= {"psnr": errors[best][0], "psnr_body": errors[best][1]}
    return motions[best], metrics | {"poses_kept": float(best == "refined")}, shown[best]


def render_frames(
    learning: Learning, body: Body, motion: Motion, camera: Camera, positions: np.ndarray
) -> list[np.ndarray]:
    """Pictures on white, uint8, of the field in the poses of some frames."""
    poses = canonical_to_world(body, motion.select(positions))
    grid, skin = learning.occupancy.grid(), learning.scene.skin
    return [
        premultiplied_on_white(render_field(learning.field, grid, body, pose, camera, skin).numpy()) for pose in poses
    ]


def mean_psnr(renders: list[np.ndarray], truths: list[Picture]) -> tuple[float, float]:
    """Mean decibels of whole images on white, and of body pixels alone."""
    pairs = [(render, on_white(*truth), body_pixels(truth[1])) for render, truth in zip(renders, truths, strict=True)]
    if not pairs:
        return 0.0, 0.0
    full = np.mean([psnr_db(render, truth) for render, truth, _ in pairs])
    return float(full), float(np.mean([psnr_db(*pair) for pair in pairs if pair[2].any()]))


def write_preview(path: Path, renders: list[np.ndarray], truths: list[Picture]) -> None:
    """Validation frames in pairs: the field's render beside the truth."""
    pairs = [np.concatenate([render, on_white(*truth)], axis=1) for render, truth in zip(renders, truths, strict=True)]
    if pairs:
        write_rgb(path, np.concatenate(pairs[:PREVIEW_FRAMES], axis=0))


STAGE = Stage(
    "field",
    version=1,
    needs=("frames", "body"),
    makes=("field.safetensors", "occupancy.npz", "motion.npz"),
    config=FieldConfig,
    run=run,
)

if __name__ == "__main__":
    raise SystemExit(main(STAGE))
