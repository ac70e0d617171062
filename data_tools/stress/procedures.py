"""What a trial does: its procedure makes captures and runs in a folder, and returns scores.

python -m data_tools.stress.procedures REQUEST.json SCORES.json

runs one trial; `data_tools.stress.run_trial` starts it as a process of its own, so that a crash or a leak of one trial
is a result and does not end the sweep. A refusal (UserError) ends it with exit status 2 and one sentence; a machine
that lacks what the trial needs (CannotRunError), with exit status `EXIT_CANNOT_RUN`.
"""

import json
import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

import stages
from data_tools.command import run_command
from data_tools.folder import atomic_folder
from data_tools.stress.captures import make_capture, true_view_deg
from data_tools.stress.cluster import cluster_scores
from data_tools.stress.hostile.run import hostile_scores
from data_tools.stress.interruption import interruption_scores
from data_tools.stress.measures import MEASURES
from data_tools.stress.row import EXIT_CANNOT_RUN, CannotRunError, Number
from data_tools.stress.store import PRESET_FILE
from data_tools.sweep.runs import find_video
from pipeline.body.body import Motion
from pipeline.body.files import load_motion, save_motion
from pipeline.core.atomic import atomic_path
from pipeline.core.lock import run_lock
from pipeline.core.manifest import MANIFEST_FILE, digest_files, read_manifest, write_manifest
from pipeline.core.parent import die_with_parent
from pipeline.core.progress import warn
from pipeline.core.record import RunRecord, write_record
from pipeline.core.stage import plan_stage, run_stage
from pipeline.geometry.rotation import axis_angle_to_quaternion, quaternion_multiply

KEPT_STAGES = ("frames", "body")
"""Stages whose results are kept by their fingerprint: trials that differ later need not run them again."""


@dataclass(frozen=True)
class Workshop:
    """Folders of a trial: captures, shared by all trials, and its own run."""

    captures: Path
    run: Path


def reconstruct(
    workshop: Workshop,
    *,
    capture: Mapping[str, Any] | None = None,
    video: str | None = None,
    corruption: Mapping[str, Number] | None = None,
    overrides: Mapping[str, Any] | None = None,
    told_focal_ratio: Number | None = None,
    pose_noise: Sequence[Number] | None = None,
    measure: str = "avatar",
) -> Mapping[str, float]:
    """Run the stages that a measure needs on a capture, and return its scores.

    Args:
        workshop: folders.
        capture, corruption: see `make_capture`.
        video: a real video instead of a capture; then the measure must not need the truth.
        overrides: options by "section.key".
        told_focal_ratio: tell the body stage this multiple of the true focal length.
        pose_noise: standard deviations of what is added to the fitted poses: joint angles (degrees), root (metres).
        measure: name in `MEASURES`.

    Raises:
        UserError: a stage refused the input.
    """
    folder = Path(video) if video else make_capture(workshop.captures, capture or {}, corruption or {})
    chosen = dict(overrides or {})
    if told_focal_ratio is not None:
        half = np.radians(0.5 * true_view_deg(folder))
        chosen["body.field_of_view_deg"] = float(np.degrees(2.0 * np.arctan(np.tan(half) / told_focal_ratio)))
    record = RunRecord(str(find_video(folder).resolve()), str(PRESET_FILE), chosen)
    workshop.run.mkdir(parents=True, exist_ok=True)
    write_record(record, workshop.run)
    configs = stages.PIPELINE.build_configs(record)
    last = MEASURES[measure].last_stage
    with run_lock(workshop.run):
        for name in stages.STAGES[: stages.STAGES.index(last) + 1]:
            plan = plan_stage(stages.load_stage(name), configs[name], workshop.run, record.video_path)
            kept = workshop.captures.with_name("stages") / plan.fingerprint
            if name in KEPT_STAGES and kept.is_dir() and not plan.folder.exists():
                shutil.copytree(kept, plan.folder)
            if not run_stage(plan):  # finished in another trial or before an interruption
                _repeat_warnings(plan.folder)
            if name in KEPT_STAGES and not kept.exists():
                with atomic_folder(kept) as part:
                    shutil.copytree(plan.folder, part, dirs_exist_ok=True)
            if name == "body" and pose_noise is not None:
                joints_deg, root_m = map(float, pose_noise)
                add_pose_noise(workshop.run / "body", joints_deg, root_m)
    return MEASURES[measure].scores(folder, workshop.run)


def _repeat_warnings(folder: Path) -> None:
    manifest = read_manifest(folder)
    for message in manifest.warnings if manifest else []:
        warn(message)


def add_pose_noise(folder: Path, joints_deg: float, root_m: float, seed: int = 0) -> None:
    """Perturb the poses of a body folder of a stress run; its manifest then describes the perturbed files.

    Each joint angle about a random axis, and each coordinate of the root, gets normal noise. Applied once only: a
    folder that is already perturbed says so in its metrics.
    """
    manifest = read_manifest(folder)
    if manifest is None or "pose_noise_deg" in manifest.metrics:
        return
    motion = load_motion(folder / "motion.npz")
    save_motion(folder / "motion.npz", noisy_motion(motion, joints_deg, root_m, seed))
    metrics = {**manifest.metrics, "pose_noise_deg": joints_deg}
    write_manifest(replace(manifest, outputs=digest_files(folder), metrics=metrics), folder / MANIFEST_FILE)


def noisy_motion(motion: Motion, joints_deg: float, root_m: float, seed: int) -> Motion:
    """Return a motion with normal noise; the angle of each joint has the standard deviation `joints_deg`."""
    random = np.random.default_rng([seed, 3])
    shape = motion.rotations_wxyz.shape
    axis = random.standard_normal((*shape[:2], 3))
    axis /= np.linalg.norm(axis, axis=2, keepdims=True)
    angle = np.radians(joints_deg) * random.standard_normal((*shape[:2], 1))
    noise = axis_angle_to_quaternion(torch.from_numpy(axis * angle))
    rotations = quaternion_multiply(torch.from_numpy(motion.rotations_wxyz).double(), noise)
    root = motion.root_translation_m + root_m * random.standard_normal(motion.root_translation_m.shape)
    return motion.with_pose(rotations.float().numpy(), root.astype(np.float32))


PROCEDURES: Mapping[str, Callable[..., Mapping[str, float]]] = {
    "reconstruct": reconstruct,
    "hostile": lambda workshop, **settings: hostile_scores(workshop.run, **settings),
    "cluster": lambda workshop, **settings: cluster_scores(workshop.captures, workshop.run, **settings),
    "interruption": lambda workshop, **settings: interruption_scores(workshop.captures, workshop.run, **settings),
}


def main(argv: Sequence[str]) -> None:
    """Run the trial of a JSON file (procedure, settings, captures, run) and write its scores to another."""
    request_file, scores_file = map(Path, argv)
    request = json.loads(request_file.read_text(encoding="utf-8"))
    workshop = Workshop(Path(request["captures"]), Path(request["run"]))
    scores = PROCEDURES[request["procedure"]](workshop, **request["settings"])
    numbers = {name: float(value) if np.isfinite(value) else None for name, value in scores.items()}
    with atomic_path(scores_file) as part:
        part.write_text(json.dumps(numbers, indent=2, allow_nan=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    die_with_parent()
    try:
        raise SystemExit(run_command(main, sys.argv[1:]))
    except CannotRunError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(EXIT_CANNOT_RUN) from None
