"""Presets over captures: accuracy against seconds, as a chart and as tables.

python -m data_tools.sweep.chart [CAPTURE ...] [--presets instant ihm --steps ihm=600 --seeds 0 1 --out runs/chart]

Every combination is a run folder below OUT, so an interrupted sweep goes on where it was; the stage that was cut starts
from its beginning, because its seconds are what the chart is about. What the first stages of two runs have in common is
computed once and copied; its seconds count for both. OUT then holds `chart.svg`, `chart.png`,
`chart.csv` (a line a run) and `anytime.csv` (the field's scores while it learnt).
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
from data_tools.sweep.chart_figure import PANELS, ChartPoint, draw_chart, pareto_front, preset_means, save_chart
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

# The generated people that are taken when no capture is named: where they lie, and the seed that makes them.
SAMPLE_CAPTURES = {Path("runs/sample-capture"): 0, Path("runs/sample-capture-1"): 1}
TEST_PRESET = "smoke"


def main(argv: Sequence[str]) -> None:
    """Run what is missing, then draw.

    Raises:
        UserError: a capture or preset is not there, two would share a run, or some runs are not done or not compared
            with their truth (the others are drawn all the same).
    """
    options = _parse(argv)
    steps = _parse_steps(options)
    for preset in options.presets:
        validate_run_options(preset, [f"{FIELD}.steps={steps[preset]}"] if preset in steps else [])
    captures = options.captures or list(SAMPLE_CAPTURES)
    if not options.captures:
        _make_sample_captures()
    missing = [str(path) for path in captures if not path.exists()]
    if missing:
        raise UserError(f"{missing[0]} does not exist: give synthetic captures, videos or folders of images")
    combinations = product(options.seeds, captures, options.presets)
    trials = [Trial(capture, preset, seed, options.out, steps.get(preset)) for seed, capture, preset in combinations]
    require_distinct_run_folders(trials)
    process_trial = _read_only if options.draw else run_and_compare
    runs = {trial: process_trial(trial, trials) for trial in track(trials, "runs")}
    write_results(options.out, runs)
    _raise_if_incomplete(runs, options.out)
    print(f"{len(runs)} runs: {options.out}/chart.svg, chart.png, chart.csv, anytime.csv")


def run_and_compare(trial: Trial, other_trials: Sequence[Trial]) -> RunState:
    """Run and compare what is not done yet. One trial at a time: they are timed, so nothing runs beside them.

    others: what came out the same in their folders is copied, with its seconds.
    """
    run = read_trial(trial)
    if run.status != "done":
        tqdm.write(f"{trial.run_dir.name}: started, says what it does in {log_path(trial.run_dir)}", file=sys.stderr)
        run_trial(trial, other_trials)
        run = read_trial(trial)
    if run.status == "done":
        compare_with_truth(trial)
        run = read_trial(trial)
    summary = f"{trial.run_dir.name}: {run.status}, {run.seconds(STAGES_UNTIL_EXPORT):.0f} s"
    tqdm.write(f"{summary}, {run.failure}" if run.status == "failed" else summary, file=sys.stderr)
    return run


def _raise_if_incomplete(runs: Mapping[Trial, RunState], out: Path) -> None:
    """UserError that names the runs which are not done, or not compared with their truth."""
    done = [trial for trial, run in runs.items() if run.status == "done"]
    incomplete = {
        "not done": [trial for trial in runs if trial not in done],
        "not compared with their truth": [trial for trial in done if needs_comparison(trial)],
    }
    summary = [
        f"{len(found)} of {len(runs)} runs are {what} ({', '.join(trial.run_dir.name for trial in found)})"
        for what, found in incomplete.items()
        if found
    ]
    if summary:
        raise UserError(f"{', '.join(summary)}: see {out}/chart.csv; the same command tries them again")


def write_results(out: Path, runs: Mapping[Trial, RunState]) -> None:
    """Tables of all runs, and the chart of those that are done."""
    out.mkdir(parents=True, exist_ok=True)
    points = [chart_point(trial, run) for trial, run in runs.items() if run.status == "done"]
    rows = [
        table_row(trial, run) | {"pareto_optimal_in": _pareto_optimal_scores(trial, points)}
        for trial, run in runs.items()
    ]
    write_csv(out / "chart.csv", list(rows[0]), [list(row.values()) for row in rows])
    curves = [(point.capture, point.preset, point.seed, *row) for point in points for row in point.curve]
    write_csv(out / "anytime.csv", ("capture", "preset", "seed", *PROGRESS_COLUMNS), curves)
    if any(point.scores for point in points):
        save_chart(draw_chart(points, provenance(rows)), out)


def provenance(rows: Sequence[Mapping[str, Any]]) -> str:
    """Commit, machine and seeds of the runs that are done."""
    done = [row for row in rows if row["status"] == "done"]
    commit, machine, seeds = (join_distinct(str(row[name]) for row in done) for name in ("commit", "machine", "seed"))
    return f"commit {commit or 'unknown'}; {machine}; seed {seeds}"


def _pareto_optimal_scores(trial: Trial, points: Sequence[ChartPoint]) -> str:
    """The scores on whose Pareto front the trial's preset lies."""
    on = []
    for panel in PANELS:
        means = preset_means([point for point in points if point.capture == trial.capture_name], panel.mesh_score)
        front = pareto_front(list(means.values()), panel.higher_is_better)
        if trial.label in [list(means)[index] for index in front]:
            on.append(panel.mesh_score)
    return " ".join(on)


def _read_only(trial: Trial, other_trials: Sequence[Trial]) -> RunState:
    return read_trial(trial)


def _make_sample_captures() -> None:
    """The generated people's captures, where they are not there yet. UserError where another version made one."""
    for path, seed in SAMPLE_CAPTURES.items():
        if not path.exists():
            make_sample([str(path), "--seed", str(seed)])
        elif read_capture_settings(path).get("version") != CAPTURE_VERSION:
            raise UserError(f"{path} is of another version of the program: remove it, and it is made anew")


def _parse_steps(options: argparse.Namespace) -> dict[str, int]:
    """Training steps by preset, of those whose own number is not taken.

    Raises:
        UserError: an entry names no chosen preset, or no whole number.
    """
    steps = {}
    for entry in options.steps:
        preset, _, number = entry.rpartition("=")
        if preset not in options.presets or not number.isdecimal():
            raise UserError(f"--steps {entry}: give PRESET=N with one of {', '.join(options.presets)}")
        steps[preset] = int(number)
    return steps


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m data_tools.sweep.chart", description=(__doc__ or "").splitlines()[0]
    )
    presets = [name for name in preset_files(stages.PIPELINE.config_dir) if name != TEST_PRESET]
    parser.add_argument("captures", nargs="*", type=Path, help="captures, videos or image folders; two people if none")
    parser.add_argument("--presets", nargs="+", default=presets, help="names in configs/ or .yaml files; all if none")
    parser.add_argument("--steps", nargs="+", default=[], help="PRESET=N: so many training steps of its field instead")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0], help="seeds of the stages that draw at random")
    parser.add_argument("--out", type=Path, default=Path("runs/chart"), help="where runs, tables and chart are made")
    parser.add_argument("--draw", action="store_true", help="run nothing, draw what is done")
    return parser.parse_args(argv)


if __name__ == "__main__":
    raise SystemExit(run_command(main, sys.argv[1:]))
