"""Run the pipeline with the true camera, masks and joint rotations of a synthetic capture: what is left is shape.

python -m data_tools.evaluate.true_motion CAPTURE RUN [--preset default]

Frames get the true camera and masks as a user supplies them: RUN-true_input is the capture with both beside its video.
The body is fitted with them; then the rotations of its joints are replaced by the true ones, retargeted, and its root
is placed accordingly. The shape is the fitted one. `make compare RUN=RUN TRUTH=RUN-true_input` scores the result.
"""

import argparse
import json
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

import stages
from data_tools.command import run_command
from data_tools.evaluate.comparison import MatchedRigs
from data_tools.evaluate.truth import SAMPLE, load_ground_truth, read_capture_settings
from data_tools.folder import atomic_folder
from pipeline.body.body import Motion, canonical_to_world
from pipeline.body.files import load_body, load_camera, load_motion, save_motion
from pipeline.core.command import format_module_command
from pipeline.core.errors import UserError
from pipeline.core.lock import run_lock
from pipeline.core.manifest import digest_json, digest_video
from pipeline.core.parent import die_with_parent_environment
from pipeline.core.record import RunRecord, read_record, write_record
from pipeline.core.stage import StagePlan, plan_stage, run_stage

BODY, MOTION = "body", "motion.npz"


def main(argv: Sequence[str]) -> None:
    """Run all stages that are not fresh.

    Raises:
        UserError: the capture has no ground truth, or a stage failed; its message is on standard error.
    """
    options = _parse(argv)
    run_dir: Path = options.run
    supplied = run_dir.with_name(f"{run_dir.name}-true_input")
    prepare_run(options.capture, supplied, run_dir, options.preset)
    for name in stages.STAGES:
        if name == BODY:
            with run_lock(run_dir):
                run_stage(plan_body(run_dir, options.capture))
            continue
        command = [sys.executable, "-m", "stages", name, str(run_dir)]
        if subprocess.run(command, env=die_with_parent_environment(), check=False).returncode != 0:
            raise UserError(f"stage {name} of {run_dir} failed; repair its cause and run the same command again")


def prepare_run(capture: Path, supplied: Path, run_dir: Path, preset: str) -> None:
    """Make the capture with the true input, unless it exists, and record it as the video of a run.

    Raises:
        UserError: the capture has no ground truth, `supplied` is of another capture, or the run is of another video.
    """
    read_capture_settings(capture)
    video, known = (supplied / "video").resolve(), read_record(run_dir).video_path
    if known not in (None, video):
        raise UserError(f"{run_dir} belongs to the video {known}: name another run folder")
    if not supplied.exists():
        write_true_input(capture, supplied)
    elif digest_video(supplied / "truth") != digest_video(capture / "truth"):
        raise UserError(f"{supplied} is not of the capture {capture}: remove it, or name another run folder")
    run_dir.mkdir(parents=True, exist_ok=True)
    with run_lock(run_dir):
        write_record(RunRecord(str(video), preset), run_dir)


def write_true_input(capture: Path, folder: Path) -> None:
    """Make a copy of a capture whose video has the true camera and the true masks beside it.

    Raises:
        UserError: the capture has no ground truth, or was filmed with a camera in the hand or a lens with distortion.
    """
    truth = load_ground_truth(capture)
    if truth.hand_held_deg or truth.distortion:
        raise UserError(
            f"{capture} has a hand-held camera or a lens with distortion (--hand-held-deg {truth.hand_held_deg:g}, "
            f"--distortion {truth.distortion:g}), its true masks are of an ideal camera that stands still; make a "
            f"capture without these options: {format_module_command(SAMPLE, 'NEW_FOLDER')}"
        )
    camera = truth.camera
    numbers = {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "width", "height")}
    calibration = {**numbers, "world_to_camera": camera.world_to_camera.tolist()}
    with atomic_folder(folder) as part:
        shutil.copytree(capture / "truth", part / "truth")
        shutil.copytree(capture / "video", part / "video")
        shutil.copytree(capture / "truth" / "masks", part / "video" / "masks")
        (part / "video" / "camera.json").write_text(json.dumps(calibration) + "\n", encoding="utf-8")


def plan_body(run_dir: Path, capture: Path) -> StagePlan:
    """Plan the body stage of a run such that its motion is the true one."""
    record = read_record(run_dir)
    stage, config = stages.load_stage(BODY), stages.PIPELINE.build_configs(record)[BODY]
    stage = replace(stage, run=partial(fit_with_true_motion, fit=stage.run, capture=capture))
    plan = plan_stage(stage, config, run_dir, record.video_path)
    return replace(plan, fingerprint=digest_json({"stage": plan.fingerprint, "motion": "true"}))


def fit_with_true_motion(
    inputs: Mapping[str, Path], out: Path, config: Any, *, fit: Any, capture: Path
) -> Mapping[str, float]:
    """Run the body stage, then replace its motion; see `true_motion`. Its scores are those of the fit."""
    metrics: Mapping[str, float] = fit(inputs, out, config)
    body, camera = load_body(out / "body.npz"), load_camera(out / "camera.npz")
    rigs = MatchedRigs(body, load_motion(out / MOTION), camera, load_ground_truth(capture))
    save_motion(out / MOTION, true_motion(rigs))
    return metrics


def true_motion(rigs: MatchedRigs) -> Motion:
    """Return the true motion for the rig of a run, whose camera is the true one.

    Rotations are the true ones times the mean difference of the rigs; roots lie where the fitted ones lie on average.
    """
    fitted, truth = rigs.motion, rigs.truth
    motion = rigs.match(truth.motion.select(fitted.frame_index))
    rotations = canonical_to_world(rigs.body, motion)[:, 0, :3, :3].double().numpy()
    roots_m = fitted.root_translation_m, motion.root_translation_m
    return fitted.with_pose(motion.rotations_wxyz, place_roots(*roots_m, rotations, truth.camera.centre_m()))


def place_roots(
    fitted_m: Float[np.ndarray, "n 3"],
    true_m: Float[np.ndarray, "n 3"],
    rotations: Float[np.ndarray, "n 3 3"],
    centre_m: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "n 3"]:
    """Return roots C + s (true - C) + R o with the scale s and the offset o for which they are nearest to the fitted.

    A camera does not see the scale of the world about its centre C; rigs differ in where the root is in the body.

    Args:
        rotations: of the root, rest to world.
    """
    columns = np.concatenate([(true_m - centre_m)[..., None], rotations], axis=2).astype(np.float64)
    solution, *_ = np.linalg.lstsq(columns.reshape(-1, 4), (fitted_m - centre_m).reshape(-1), rcond=None)
    placed: Float[np.ndarray, "n 3"] = (columns @ solution + centre_m).astype(np.float32)
    return placed


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m data_tools.evaluate.true_motion", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("capture", type=Path, help="synthetic capture, from data_tools.sample or data_tools.from_gltf")
    parser.add_argument("run", type=Path, help="run folder; RUN-true_input beside it gets the capture")
    parser.add_argument("--preset", default="default", help="preset (default: default)")
    return parser.parse_args(argv)


if __name__ == "__main__":
    raise SystemExit(run_command(main, sys.argv[1:]))
