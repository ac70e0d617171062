"""Run presets on captures, and chart accuracy against run time.

python -m data_tools.sweep.chart [CAPTURE ...] [--presets instant ihm --steps ihm=600 --seeds 0 1 --out runs/chart]

Each combination has a run folder in OUT, so the same command continues an interrupted sweep; the interrupted stage
restarts from its beginning, because its time is measured. Stages with equal inputs and options are computed once and
copied; their seconds count for each run. Outputs in OUT: `chart.svg` (accuracy against time), `sizes.svg` (against
parameters, faces, bytes), both also as .png, `chart.csv` (one row per run) and `anytime.csv` (scores during training).
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

from tqdm import tqdm

import stages
from data_tools.command import run_command
from data_tools.evaluate.truth import read_capture_settings
from data_tools.sample import main as make_sample
from data_tools.sweep.chart_figure import (
    SIZE_PANELS,
    TIME_PANELS,
    ChartPoint,
    draw_chart,
    pareto_front,
    preset_means,
    save_figure,
)
from data_tools.sweep.chart_trials import (
    FIELD,
    PROGRESS_COLUMNS,
    STAGES_UNTIL_EXPORT,
    Trial,
    chart_point,
    compare_with_truth,
    join_distinct,
    needs_comparison,
    read_trial,
    require_distinct_run_folders,
    run_trial,
    table_row,
)
from data_tools.sweep.runs import RunState, log_path, validate_run_options, write_csv
from data_tools.synthetic.scene.capture import CAPTURE_VERSION
from pipeline.core.config import preset_files
from pipeline.core.errors import UserError
from pipeline.core.progress import track

# Captures of generated people, used if no capture is named: folder and seed.
SAMPLE_CAPTURES = {Path("runs/sample-capture"): 0, Path("runs/sample-capture-1"): 1}
TEST_PRESET = "smoke"


def main(argv: Sequence[str]) -> None:
    """Run what is missing, then write chart and tables.

    Raises:
        UserError: a capture or preset does not exist, two combinations would share a run, or some runs are unfinished
            or not compared with their ground truth (the others are in the chart).
    """
    options = _parse(argv)
    steps = _parse_steps(options)
    for preset in options.presets:
        validate_run_options(preset, [*options.set, *([f"{FIELD}.steps={steps[preset]}"] if preset in steps else [])])
    captures = options.captures or list(SAMPLE_CAPTURES)
    if not options.captures:
        _make_sample_captures()
    missing = [str(path) for path in captures if not path.exists()]
    if missing:
        raise UserError(f"{missing[0]} does not exist: name synthetic captures, videos or folders of images")
    combinations = product(options.seeds, captures, options.presets)
    overrides = tuple(options.set)
    trials = [
        Trial(capture, preset, seed, options.out, steps.get(preset), overrides)
        for seed, capture, preset in combinations
    ]
    require_distinct_run_folders(trials)
    process_trial = _read_only if options.draw else run_and_compare
    runs = {trial: process_trial(trial, trials) for trial in track(trials, "runs")}
    if options.draw and any(run.status == "done" for run in runs.values()):
        runs = {trial: run for trial, run in runs.items() if run.status == "done"}
    write_results(options.out, runs)
    _raise_if_incomplete(runs, options.out)
    print(f"{len(runs)} runs: {options.out}/chart.svg, sizes.svg, chart.csv, anytime.csv")


def run_and_compare(trial: Trial, other_trials: Sequence[Trial]) -> RunState:
    """Run a trial if it is unfinished, and compare it with its ground truth. Trials are timed, so they run one by one.

    other_trials: stages with equal results are copied from their runs, with their seconds.
    """
    run = read_trial(trial)
    if run.status != "done":
        tqdm.write(f"{trial.run_dir.name}: started, log in {log_path(trial.run_dir)}", file=sys.stderr)
        run_trial(trial, other_trials)
        run = read_trial(trial)
    if run.status == "done":
        compare_with_truth(trial.capture, trial.run_dir)
        run = read_trial(trial)
    summary = f"{trial.run_dir.name}: {run.status}, {run.seconds(STAGES_UNTIL_EXPORT):.0f} s"
    tqdm.write(f"{summary}, {run.failure}" if run.status == "failed" else summary, file=sys.stderr)
    return run


def _raise_if_incomplete(runs: Mapping[Trial, RunState], out: Path) -> None:
    """Raise UserError with the names of the runs that are unfinished or not compared with their ground truth."""
    done = [trial for trial, run in runs.items() if run.status == "done"]
    incomplete = {
        "not done": [trial for trial in runs if trial not in done],
        "not compared with their ground truth": [
            trial for trial in done if needs_comparison(trial.capture, trial.run_dir)
        ],
    }
    summary = [
        f"{len(found)} of {len(runs)} runs are {problem} ({', '.join(trial.run_dir.name for trial in found)})"
        for problem, found in incomplete.items()
        if found
    ]
    if summary:
        raise UserError(f"{', '.join(summary)}: see {out}/chart.csv; run the same command to try again")


def write_results(out: Path, runs: Mapping[Trial, RunState]) -> None:
    """Write the tables of all runs, and the chart of the finished ones."""
    out.mkdir(parents=True, exist_ok=True)
    points = [chart_point(trial, run) for trial, run in runs.items() if run.status == "done"]
    rows = [
        table_row(trial, run) | {"pareto_optimal_in": _pareto_optimal_scores(trial, points)}
        for trial, run in runs.items()
    ]
    write_csv(out / "chart.csv", list(rows[0]), [list(row.values()) for row in rows])
    curves = [(point.capture, point.preset, point.seed, *row) for point in points for row in point.curve]
    write_csv(out / "anytime.csv", ("capture", "preset", "seed", *PROGRESS_COLUMNS), curves)
    for name, panels in (("chart", TIME_PANELS), ("sizes", SIZE_PANELS)):
        if any(panel.place(point) for panel in panels for point in points):
            save_figure(draw_chart(points, provenance(rows), panels), out, name, dpi=130)


def provenance(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return commit, machine and seeds of the finished runs."""
    done = [row for row in rows if row["status"] == "done"]
    commit, machine, seeds = (join_distinct(str(row[name]) for row in done) for name in ("commit", "machine", "seed"))
    return f"commit {commit or 'unknown'}; {machine}; seed {seeds}"


def _pareto_optimal_scores(trial: Trial, points: Sequence[ChartPoint]) -> str:
    """Return the scores for which the preset of the trial is Pareto-optimal in time."""
    on = []
    for panel in TIME_PANELS:
        means = preset_means([point for point in points if point.capture == trial.capture_name], panel)
        front = pareto_front(list(means.values()), panel.higher_is_better)
        if trial.label in [list(means)[index] for index in front]:
            on.append(panel.score)
    return " ".join(on)


def _read_only(trial: Trial, other_trials: Sequence[Trial]) -> RunState:
    return read_trial(trial)


def _make_sample_captures() -> None:
    """Make the captures of generated people that do not exist. UserError if one is of another version."""
    for path, seed in SAMPLE_CAPTURES.items():
        if not path.exists():
            make_sample([str(path), "--seed", str(seed)])
        elif read_capture_settings(path).get("version") != CAPTURE_VERSION:
            raise UserError(f"{path} was made by another version of the program: remove it and run the same command")


def _parse_steps(options: argparse.Namespace) -> dict[str, int]:
    """Return the training steps by preset from --steps.

    Raises:
        UserError: an entry does not name a selected preset, or its number is not an integer.
    """
    steps = {}
    for entry in options.steps:
        preset, _, number = entry.rpartition("=")
        if preset not in options.presets or not number.isdecimal():
            raise UserError(f"--steps {entry}: write PRESET=N with one of {', '.join(options.presets)}")
        steps[preset] = int(number)
    return steps


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m data_tools.sweep.chart", description=(__doc__ or "").splitlines()[0]
    )
    presets = [name for name in preset_files(stages.PIPELINE.config_dir) if name != TEST_PRESET]
    parser.add_argument(
        "captures", nargs="*", type=Path, help="captures, videos or image folders; default: two generated people"
    )
    parser.add_argument("--presets", nargs="+", default=presets, help="names in configs/ or .yaml files; default: all")
    parser.add_argument("--steps", nargs="+", default=[], help="PRESET=N: other number of training steps of the field")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="SECTION.KEY=VALUE",
        help="option of all runs",
    )
    parser.add_argument("--seeds", nargs="+", type=int, default=[0], help="seeds of the stages that use random numbers")
    parser.add_argument("--out", type=Path, default=Path("runs/chart"), help="folder of runs, tables and chart")
    parser.add_argument("--draw", action="store_true", help="run nothing, chart the finished runs")
    return parser.parse_args(argv)


if __name__ == "__main__":
    raise SystemExit(run_command(main, sys.argv[1:]))
