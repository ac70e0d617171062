"""Sweep of the field stage: change one size or one part of it, on the frames and bodies of finished runs.

python -m data_tools.sweep.ablate_field RUN [RUN ...] [--rows ...] [--group size|attention] [--seeds 0] [--truth]

Scores are those of validation frames, never of held-out frames; `--truth` adds those against the ground truth of the
synthetic capture RUN-capture: novel views and poses, haze, surface. The same command continues an interrupted sweep.
Outputs in OUT: `field.csv` (one line per training) and `field.md` (means, and differences from the reference).
"""

import argparse
import sys
from collections.abc import Sequence
from functools import cache
from itertools import product
from pathlib import Path

from tqdm import tqdm

from data_tools.command import run_command
from data_tools.evaluate.compare import require_video_of
from data_tools.evaluate.truth import read_capture_settings, require_current_version
from data_tools.sweep.field_rows import GROUPS, REFERENCE, ROWS, SIZE, rows_of_group
from data_tools.sweep.field_tables import write_tables
from data_tools.sweep.field_trials import FieldTrial, TrialScores, read_trial, run_trial
from pipeline.capture.capture import load_capture
from pipeline.capture.usable_frames import usable_positions
from pipeline.core.errors import UserError
from pipeline.core.progress import track
from pipeline.field.config import FieldConfig

VALIDATION_FRAMES = 12
"""Validation frames that are scored where they judge; the stage, and a comparison with the truth, render four."""


def main(argv: Sequence[str]) -> None:
    """Run what is missing, then write the tables.

    Raises:
        UserError: a run or its capture does not exist, they do not belong together, or a training failed.
    """
    options = _parse(argv)
    for run in options.runs:
        for folder in (run / "frames", run / "body"):
            if not folder.is_dir():
                raise UserError(f"{folder} does not exist: name runs whose body stage is finished")
        if options.truth:
            capture = _capture(run)
            require_current_version(capture, read_capture_settings(capture))
            require_video_of(capture, run)
    names = options.rows or rows_of_group(options.group)
    names.sort(key=lambda name: name != REFERENCE)
    trials = [_trial(run, name, seed, options) for seed, name, run in product(options.seeds, names, options.runs)]
    results: dict[FieldTrial, TrialScores] = {}
    for trial in track(trials, "trainings"):
        result = read_trial(trial) if options.write_only else run_trial(trial)
        if result is not None:
            results[trial] = result
            tqdm.write(f"{trial.folder.name}: {result.scores}", file=sys.stderr)
            write_tables(options.out, results, _command(options))
    print(f"{len(results)} of {len(trials)} trainings: {options.out}/field.csv, field.md")


def _capture(run: Path) -> Path:
    return run.with_name(f"{run.name}-capture")


@cache
def _training_frames(run: Path) -> int:
    """Return the number of training frames of a run, so that half of `max_frames` is half of what is used."""
    return len(usable_positions(load_capture(run / "frames"), run / "body"))


def _trial(run: Path, name: str, seed: int, options: argparse.Namespace) -> FieldTrial:
    base = FieldConfig.model_validate({"seed": seed})
    base = base if options.truth else base.model_copy(update={"validation_frames": VALIDATION_FRAMES})
    base = base if options.steps is None else base.model_copy(update={"steps": options.steps})
    base = base.model_copy(update={"max_frames": min(base.max_frames, _training_frames(run))})
    truth = _capture(run) if options.truth else None
    return FieldTrial(run, ROWS[name], seed, ROWS[name].config(base), truth, options.out)


def _command(options: argparse.Namespace) -> str:
    """Return the command that makes the same tables."""
    parts = ["python -m data_tools.sweep.ablate_field", *map(str, options.runs)]
    parts += ["--rows", *options.rows] if options.rows else ["--group", options.group]
    parts += ["--seeds", *map(str, options.seeds)]
    parts += ["--steps", str(options.steps)] if options.steps is not None else []
    return " ".join([*parts, *(["--truth"] if options.truth else [])])


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m data_tools.sweep.ablate_field", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("runs", nargs="+", type=Path, help="finished runs, whose frames and body are used")
    parser.add_argument("--group", choices=GROUPS, default=SIZE, help="rows that belong together")
    parser.add_argument("--rows", nargs="+", choices=list(ROWS), help="rows; default: those of the group")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0], help="seeds of the field; default: 0")
    parser.add_argument("--steps", type=int, help="training steps of the reference; default: those of the stage")
    parser.add_argument("--truth", action="store_true", help="score against the truth of the capture RUN-capture")
    parser.add_argument("--out", type=Path, default=Path("runs/ablate-field"), help="folder of fields and tables")
    parser.add_argument("--write-only", action="store_true", help="write the tables of finished trainings only")
    return parser.parse_args(argv)


if __name__ == "__main__":
    raise SystemExit(run_command(main, sys.argv[1:]))
