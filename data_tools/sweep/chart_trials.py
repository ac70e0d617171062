"""One combination of capture, preset and seed: its run folder, scores and run times."""

import csv
import shutil
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import stages
from data_tools.evaluate.files import load_comparison_scores
from data_tools.folder import atomic_folder
from data_tools.sweep.chart_figure import ChartPoint
from data_tools.sweep.runs import (
    SCORE_PATHS,
    RunState,
    find_video,
    log_path,
    read_run,
    reusable_stages,
    start_run,
)
from pipeline.core.config import parse_overrides
from pipeline.core.errors import UserError
from pipeline.core.lock import run_lock
from pipeline.core.progress import warn
from pipeline.core.record import RunRecord, update_record
from pipeline.core.run_folder import default_run_dir

FIELD = "field"
STAGES_UNTIL_FIELD = ("frames", "body", FIELD)
STAGES_BEFORE_FIELD = STAGES_UNTIL_FIELD[:-1]
STAGES_UNTIL_EXPORT = tuple(name for name in stages.STAGES if name != "report")
SIZE_METRICS = {
    "parameters": (FIELD, "parameters"),
    "glb_faces": ("export", "glb_faces"),
    "glb_bytes": ("export", "glb_bytes"),
}
"""Column of the table, stage and metric of each size."""
PROGRESS_COLUMNS = ("seconds", "validation_psnr_db", "validation_psnr_body_db")


@dataclass(frozen=True)
class Trial:
    """One run of a sweep.

    Attributes:
        preset: name in configs/ or a .yaml file.
        out: parent of the run folder.
        steps: training steps of the field; None: those of the preset.
        overrides: further options, as `section.key=value`.
    """

    capture: Path
    preset: str
    seed: int
    out: Path
    steps: int | None = None
    overrides: tuple[str, ...] = ()

    @property
    def capture_name(self) -> str:
        """Name of the capture in tables and chart."""
        return default_run_dir(self.capture).name

    @property
    def preset_name(self) -> str:
        """Name of the preset; of a file, its stem."""
        return Path(self.preset).stem

    @property
    def label(self) -> str:
        """Label of the preset in the chart."""
        steps = [] if self.steps is None else [f"{self.steps} steps"]
        return ", ".join([self.preset_name, *self.overrides, *steps])

    @property
    def run_dir(self) -> Path:
        """The run folder."""
        name = f"{self.capture_name}-{self.preset_name}-{self.seed}"
        steps = [] if self.steps is None else [f"{self.steps}-steps"]
        return self.out / "-".join([name, *(option.replace("/", "_") for option in self.overrides), *steps])

    @property
    def assignments(self) -> list[str]:
        """Options that differ from the preset, as `section.key=value`."""
        seeded = [name for name in stages.STAGES if "seed" in stages.load_stage(name).config.model_fields]
        seeds = [f"{name}.seed={self.seed}" for name in seeded]
        steps = [] if self.steps is None else [f"{FIELD}.steps={self.steps}"]
        return [*self.overrides, *seeds, *steps]

    @property
    def record(self) -> RunRecord:
        """The record that the run folder will contain."""
        record, video = RunRecord(), find_video(self.capture)
        overrides = parse_overrides(self.assignments)
        return update_record(record, self.run_dir, video, self.preset, overrides, replace_video=False)


def require_distinct_run_folders(trials: Iterable[Trial]) -> None:
    """Raise UserError if two trials have the same run folder."""
    trial_of_folder: dict[Path, Trial] = {}
    for trial in trials:
        other = trial_of_folder.setdefault(trial.run_dir, trial)
        if other != trial:
            raise UserError(
                f"{other.preset} on {other.capture} and {trial.preset} on {trial.capture} would share the run "
                f"{trial.run_dir}: rename one of them, or run them with different --out"
            )


def read_trial(trial: Trial) -> RunState:
    """Read the state of the run; stages of another capture or preset are not fresh."""
    return read_run(trial.run_dir, trial.record)


def run_trial(trial: Trial, other_trials: Iterable[Trial] = ()) -> None:
    """Run the stages that are not fresh; an interrupted stage restarts from its beginning.

    Resumed from a checkpoint, it would report only the seconds after the interruption.

    other_trials: see `copy_shared_stages`.
    """
    if trial.run_dir.is_dir():
        with run_lock(trial.run_dir):
            for part in trial.run_dir.glob("*.part"):
                shutil.rmtree(part)
    copy_shared_stages(trial, other_trials)
    chosen = [argument for assignment in trial.assignments for argument in ("--set", assignment)]
    start_run(trial.run_dir, ["--video", str(find_video(trial.capture)), "--preset", trial.preset, *chosen])


def copy_shared_stages(trial: Trial, other_trials: Iterable[Trial]) -> None:
    """Copy leading stages with equal inputs and options from other runs of the same capture.

    The copies keep their manifests with seconds, machine and commit.
    """
    for other in other_trials:
        if other.capture != trial.capture or other.run_dir == trial.run_dir:
            continue
        for name in reusable_stages(other.run_dir, trial.record):
            if not (trial.run_dir / name).exists():
                with atomic_folder(trial.run_dir / name) as part:
                    shutil.copytree(other.run_dir / name, part, dirs_exist_ok=True)


def needs_comparison(capture: Path, run_dir: Path) -> bool:
    """Return whether the capture has a ground truth and the run has no complete, current comparison with it."""
    return (capture / "truth").is_dir() and load_comparison_scores(run_dir) is None


def compare_with_truth(capture: Path, run_dir: Path) -> None:
    """Compare the run with its ground truth if needed; a failure is a warning."""
    if not needs_comparison(capture, run_dir):
        return
    command = [sys.executable, "-m", "data_tools.evaluate.compare", str(capture), str(run_dir)]
    with log_path(run_dir).open("a", encoding="utf-8") as log:
        done = subprocess.run(command, stdout=log, stderr=subprocess.STDOUT, check=False)
    if done.returncode != 0:
        warn(f"{run_dir.name} was not compared with its ground truth: see {log_path(run_dir)}")


def chart_point(trial: Trial, run: RunState) -> ChartPoint:
    """Return the data of the chart from a finished run."""
    before = run.seconds(STAGES_BEFORE_FIELD)
    curve = [(before + seconds, full, body) for seconds, full, body in read_progress(trial.run_dir / "field")]
    seconds = (run.seconds(STAGES_UNTIL_FIELD), run.seconds(STAGES_UNTIL_EXPORT))
    return ChartPoint(trial.capture_name, trial.label, trial.seed, *seconds, run.scores, curve, read_sizes(run))


def read_sizes(run: RunState) -> dict[str, float]:
    """Return the sizes of a run by column of `SIZE_METRICS`; those that a stage does not report are left out."""
    metrics = {name: manifest.metrics for name, manifest in run.manifests.items()}
    sizes = {column: metrics.get(stage, {}).get(metric) for column, (stage, metric) in SIZE_METRICS.items()}
    return {column: size for column, size in sizes.items() if size is not None}


def read_progress(field: Path) -> list[tuple[float, float, float]]:
    """Read `progress.csv`: training seconds, validation PSNR (dB) of full image and body pixels; empty if absent.

    Raises:
        UserError: a column is missing or not numeric.
    """
    path = field / "progress.csv"
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    try:
        columns = [[float(row[name]) for row in rows] for name in PROGRESS_COLUMNS]
    except (KeyError, ValueError, TypeError):
        raise UserError(f"{path} needs numbers in {', '.join(PROGRESS_COLUMNS)}: run its stage with --force") from None
    return list(zip(*columns, strict=True))


def table_row(trial: Trial, run: RunState) -> dict[str, Any]:
    """Return one row of chart.csv.

    `steps` are the training steps of the field, which may stop early. The seconds of stages in `resumed` are those
    after an interruption.
    """
    environments = [manifest.environment for manifest in run.manifests.values()]
    return {
        "capture": trial.capture_name,
        "preset": trial.preset_name,
        "seed": trial.seed,
        "steps": run.manifests[FIELD].metrics.get("steps") if FIELD in run.manifests else None,
        "status": run.status,
        "field_seconds": round(run.seconds(STAGES_UNTIL_FIELD), 3),
        "seconds": round(run.seconds(STAGES_UNTIL_EXPORT), 3),
        **{score: run.scores.get(score) for score in SCORE_PATHS},
        **(dict.fromkeys(SIZE_METRICS) | read_sizes(run)),
        "peak_rss_mib": max((manifest.peak_rss_mib for manifest in run.manifests.values()), default=None),
        "resumed": " ".join(name for name, manifest in run.manifests.items() if manifest.resumed),
        "commit": join_distinct(environment.get("commit") for environment in environments),
        "machine": join_distinct(map(describe_machine, environments)),
        "message": "" if run.status == "done" else run.failure,
    }


def join_distinct(texts: Iterable[str | None]) -> str:
    """Join the distinct non-empty texts in order."""
    return "; ".join(dict.fromkeys(text for text in texts if text))


def format_origin(commits: Iterable[str], machines: Iterable[str]) -> str:
    """Return the commits, shortened, and the machines of some runs as one sentence part."""
    short = join_distinct(short_commit(commit) for commit in commits)
    return f"Commit {short or 'unknown'}, {join_distinct(machines) or 'unknown machine'}"


def short_commit(commit: str) -> str:
    """Return ten digits of a commit, with `+` if files differed from it."""
    return f"{commit[:10]}{'+' if commit.endswith('+') else ''}"


def describe_machine(environment: dict[str, Any]) -> str:
    """Return processor, cores and GPU of the environment of a manifest."""
    parts = [environment.get("cpu"), f"{environment.get('cores')} cores", environment.get("gpu")]
    return ", ".join(part for part in parts if part)
