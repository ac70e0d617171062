"""field: the instant avatar, a radiance field in the canonical A-pose, learnt from the frames in about a minute."""

import csv
import math
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch

from pipeline.avatar import selection
from pipeline.avatar.body import Motion
from pipeline.avatar.field_config import FieldConfig
from pipeline.avatar.judge import Judge
from pipeline.avatar.prepare import Picture, spread, start_learning, training_scale
from pipeline.avatar.train import DivergedError, Learning
from pipeline.core.cli import main
from pipeline.core.device import compute_device
from pipeline.core.errors import UserError
from pipeline.core.manifest import PROGRESS
from pipeline.core.measure import MIB
from pipeline.core.progress import track, warn
from pipeline.core.stage import Stage
from pipeline.geometry.camera import Camera
from pipeline.geometry.matte import shrink
from pipeline.io.capture import Capture, load_capture
from pipeline.io.checkpoint import load_tensors, save_field, save_occupancy, save_tensors
from pipeline.io.image import to_uint8, write_rgb
from pipeline.io.npz import load_body, load_camera, load_motion, save_motion
from pipeline.io.scores import training_positions

CHECKPOINT, CHECKPOINT_EVERY_S = "checkpoint.safetensors", 15.0
PREVIEW_FRAMES = 4
LOOKS = (1 / 32, 1 / 16, 1 / 8, 1 / 4, 3 / 8, 1 / 2, 5 / 8, 3 / 4, 7 / 8, 1)
"""Parts of the steps after which the field is scored on validation frames, for the curve of accuracy over time."""


def run(inputs: Mapping[str, Path], out: Path, config: FieldConfig) -> Mapping[str, float]:
    """Learn the field on training frames, judge the refined poses on validation frames, write field, occupancy,
    motion.
    """
    capture, camera = load_capture(inputs["frames"]), load_camera(inputs["body"] / "camera.npz")
    body, motion = load_body(inputs["body"] / "body.npz"), load_motion(inputs["body"] / "motion.npz")
    camera = camera.scaled(training_scale(body, motion, camera, config.max_person_px))
    train = training_positions(capture, inputs["body"])
    train = train[spread(len(train), config.max_frames)]
    pictures = [read_picture(capture, position, camera) for position in track(train, "read frames")]
    device = compute_device(config.device, "field.device")
    learning = start_learning(body, motion.select(train), camera, pictures, config, device)
    judge = gather_judge(capture, motion, camera, config)
    seconds_per_step = learn(learning, judge, out)
    motion, metrics, renders = judge_poses(learning, judge, motion)
    save_field(out / "field.safetensors", learning.field)
    save_occupancy(out / "occupancy.npz", learning.occupancy.grid())
    save_motion(out / "motion.npz", motion)
    write_preview(out / "preview.png", renders, judge)
    return metrics | {
        "steps": learning.done,
        "seconds_per_step": seconds_per_step,
        "occupied_cells": int(learning.occupancy.occupied.sum()),
        "train_frames": len(train),
        "parameters": sum(parameter.numel() for parameter in learning.field.parameters()),
        **graphics_memory(device),
    }


def graphics_memory(device: torch.device) -> dict[str, float]:
    """The most memory that tensors took on a graphics card, MiB; nothing where none was used."""
    if device.type != "cuda":
        return {}
    return {"peak_gpu_mib": torch.cuda.max_memory_allocated(device) / MIB}


def read_picture(capture: Capture, position: int, camera: Camera) -> Picture:
    """Image and mask of a frame at the camera's size, uint8."""
    size = (camera.width, camera.height)
    image, mask = capture.image(int(position)), capture.mask(int(position))
    if (capture.width, capture.height) != size:
        image, mask = shrink(image, mask, size)
    return to_uint8(image), to_uint8(mask)


def gather_judge(capture: Capture, motion: Motion, camera: Camera, config: FieldConfig) -> Judge:
    """Some of the validation frames, evenly spread."""
    chosen = capture.positions(selection.VALIDATION)
    chosen = chosen[spread(len(chosen), config.validation_frames)] if len(chosen) else chosen
    return Judge(motion.select(chosen), camera, [read_picture(capture, position, camera) for position in chosen])


def learn(learning: Learning, judge: Judge, out: Path) -> float:
    """All steps that are still to do, with a checkpoint now and then; returns the median seconds of a step."""
    checkpoint, before_s = out / CHECKPOINT, 0.0
    if checkpoint.exists():
        tensors, about = load_tensors(checkpoint)
        learning.load_state(tensors)
        before_s = float(about["seconds"])
    progress, thin = Progress(out, learning.done), judge.thinned()
    looks = {round(part * learning.config.steps) for part in LOOKS}
    seconds, saved = [], time.monotonic()
    steps = range(learning.done, learning.config.steps)
    for _ in track(steps, "field", total=learning.config.steps, initial=learning.done):
        start = time.monotonic()
        try:
            learning.step()
        except DivergedError as error:
            raise UserError(f"the field does not learn ({error}); lower field.table_rate and try again") from None
        seconds.append(time.monotonic() - start)
        if learning.done in looks and judge.truths:
            renders = thin.render(learning, learning.refines_poses)
            progress.add(learning.done, before_s + sum(seconds), *thin.score(renders), *thin.frame_scores(renders))
            if learning.config.early_stop and progress.has_settled(learning.config.steps / 2):
                break
        if time.monotonic() - saved > CHECKPOINT_EVERY_S:
            save_tensors(checkpoint, learning.state(), {"seconds": before_s + sum(seconds)})
            saved = time.monotonic()
    progress.finish()
    return float(np.median(seconds)) if seconds else 0.0


class Progress:
    """The curve of accuracy over time, kept beside the checkpoint and published as `progress.csv`.

    A row has step, seconds, the two mean scores, and then the score of each validation frame.
    """

    COLUMNS = ("step", "seconds", "validation_psnr_db", "validation_psnr_body_db")

    def __init__(self, out: Path, done: int) -> None:
        """Go on after the rows of the steps that a checkpoint holds."""
        self.kept, self.published = out / f"checkpoint_{PROGRESS}", out / PROGRESS
        self.rows: list[tuple[float, ...]] = []
        if self.kept.exists():
            with self.kept.open(newline="", encoding="utf-8") as file:
                rows = [tuple(float(value) for value in row) for row in list(csv.reader(file))[1:]]
            self.rows = [row for row in rows if row[0] <= done]

    def add(self, step: int, seconds: float, *scores_db: float) -> None:
        """Note the scores after a step, and the seconds of learning that led there."""
        self.rows.append((step, round(seconds, 3), *(round(score, 4) for score in scores_db)))
        frames = range(len(self.rows[0]) - len(self.COLUMNS))
        with self.kept.open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows([(*self.COLUMNS, *(f"frame_{frame}_db" for frame in frames)), *self.rows])

    def has_settled(self, first_step: float) -> bool:
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
            self.kept.replace(self.published)


def judge_poses(learning: Learning, judge: Judge, motion: Motion) -> tuple[Motion, dict[str, float], list[np.ndarray]]:
    """Keep the pose corrections only if they make validation frames better, to which they come by interpolation in
    time.
    """
    ways = {"fitted": False} | ({"refined": True} if learning.config.pose_refinement else {})
    shown = {name: judge.render(learning, refined) for name, refined in ways.items()}
    scores = {name: judge.score(renders) for name, renders in shown.items()}
    best = max(scores, key=lambda name: scores[name][0]) if judge.truths else "fitted"
    if best == "fitted" and learning.config.pose_refinement:
        why = "did not make validation frames better" if judge.truths else "have no validation frames to prove them"
        warn(f"the refined poses {why} and were dropped")
    metrics = {f"psnr_{name}": score[0] for name, score in scores.items()} if judge.truths else {}
    if judge.truths:
        metrics |= {"psnr": scores[best][0], "psnr_body": scores[best][1]}
    kept = learning.poses.corrected(motion) if ways[best] else motion
    return kept, metrics | {"poses_kept": float(ways[best])}, shown[best]


def write_preview(path: Path, renders: list[np.ndarray], judge: Judge) -> None:
    """Validation frames in pairs: the field's render beside the truth."""
    pairs = [np.concatenate(pair, axis=1) for pair in zip(renders, judge.targets, strict=True)]
    if pairs:
        write_rgb(path, np.concatenate(pairs[:PREVIEW_FRAMES], axis=0))


STAGE = Stage(
    "field",
    version=8,
    needs=("frames", "body"),
    makes=("field.safetensors", "occupancy.npz", "motion.npz"),
    config=FieldConfig,
    run=run,
)

if __name__ == "__main__":
    raise SystemExit(main(STAGE))
