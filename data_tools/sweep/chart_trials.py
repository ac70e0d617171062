"""One combination of capture, preset and seed: its run, what it found, and what that cost."""

import csv
import shutil
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import stages
from data_tools.folder import atomic_folder
from data_tools.sweep.chart_figure import ChartPoint
from data_tools.sweep.runs import (
    SCORE_PATHS,
    RunState,
    find_video,
    has_current_comparison,
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
PROGRESS_COLUMNS = ("seconds", "validation_psnr_db", "validation_psnr_body_db")


@dataclass(frozen=True)
class Trial:
    """What runs, and below which folder. steps: those of the field where they are not the preset's own."""

    capture: Path
    preset: str
    seed: int
    out: Path
    steps: int | None = None

    @property
    def capture_name(self) -> str:
        """How tables and the chart call the capture."""
        return default_run_dir(self.capture).name

    @property
    def preset_name(self) -> str:
        """The preset's name, also where a file was given."""
        return Path(self.preset).stem

    @property
    def label(self) -> str:
        """How the chart calls the preset."""
        return self.preset_name if self.steps is None else f"{self.preset_name}, {self.steps} steps"

    @property
    def run_dir(self) -> Path:
        """The folder of the run."""
        name = f"{self.capture_name}-{self.preset_name}-{self.seed}"
        return self.out / (name if self.steps is None else f"{name}-{self.steps}-steps")

    @property
    def assignments(self) -> list[str]:
        """What differs from the preset, as `section.key=value`."""
        seeded = [name for name in stages.STAGES if "seed" in stages.load_stage(name).config.model_fields]
        seeds = [f"{name}.seed={self.seed}" for name in seeded]
        return seeds if self.steps is None else [*seeds, f"{FIELD}.steps={self.steps}"]

    @property
    def record(self) -> RunRecord:
        """What the run's folder will remember."""
        record, video = RunRecord(), find_video(self.capture)
        overrides = parse_overrides(self.assignments)
        return update_record(record, self.run_dir, video, self.preset, overrides, replace_video=False)


def require_distinct_run_folders(trials: Iterable[Trial]) -> None:
    """UserError when two trials would have one run: the second would show the figures of the first."""
    trial_of_folder: dict[Path, Trial] = {}
    for trial in trials:
        other = trial_of_folder.setdefault(trial.run_dir, trial)
        if other != trial:
            raise UserError(
                f"{other.preset} on {other.capture} and {trial.preset} on {trial.capture} would share the run "
                f"{trial.run_dir}: rename one of them, or give each an --out of its own"
            )


def read_trial(trial: Trial) -> RunState:
    """How far the trial's run came; what the folder holds of another capture or preset does not count."""
    return read_run(trial.run_dir, trial.record)


def run_trial(trial: Trial, other_trials: Iterable[Trial] = ()) -> None:
    """Run what is not fresh; a stage that was cut starts from its beginning.

    Gone on with from its checkpoint, it would tell only the seconds after the cut. others: see `copy_shared_stages`.
    """
    if trial.run_dir.is_dir():
        with run_lock(trial.run_dir):
            for part in trial.run_dir.glob("*.part"):
                shutil.rmtree(part)
    copy_shared_stages(trial, other_trials)
    chosen = [word for assignment in trial.assignments for word in ("--set", assignment)]
    start_run(trial.run_dir, ["--video", str(find_video(trial.capture)), "--preset", trial.preset, *chosen])


def copy_shared_stages(trial: Trial, other_trials: Iterable[Trial]) -> None:
    """Copy what would come out the same here from runs of the same capture, stage after stage until one differs.

    The copies keep their manifests: their seconds, machine and commit count here as there.
    """
    for other in other_trials:
        if other.capture != trial.capture or other.run_dir == trial.run_dir:
            continue
        for name in reusable_stages(other.run_dir, trial.record):
            if not (trial.run_dir / name).exists():
                with atomic_folder(trial.run_dir / name) as part:
                    shutil.copytree(other.run_dir / name, part, dirs_exist_ok=True)


def needs_comparison(trial: Trial) -> bool:
    """Whether the capture has a truth that the trial's report was not compared with, or not wholly, or otherwise."""
    return (trial.capture / "truth").is_dir() and not has_current_comparison(trial.run_dir / "report")


def compare_with_truth(trial: Trial) -> None:
    """Write `report/truth.json` where it lacks; a warning where that fails."""
    if not needs_comparison(trial):
        return
    command = [sys.executable, "-m", "data_tools.evaluate.compare", str(trial.capture), str(trial.run_dir)]
    with log_path(trial.run_dir).open("a", encoding="utf-8") as log:
        done = subprocess.run(command, stdout=log, stderr=subprocess.STDOUT, check=False)
    if done.returncode != 0:
        warn(f"{trial.run_dir.name} could not be compared with its truth: see {log_path(trial.run_dir)}")


def chart_point(trial: Trial, run: RunState) -> ChartPoint:
    """What the figure needs of a finished run."""
    before = run.seconds(STAGES_BEFORE_FIELD)
    curve = [(before + seconds, full, body) for seconds, full, body in read_progress(trial.run_dir / "field")]
    seconds = (run.seconds(STAGES_UNTIL_FIELD), run.seconds(STAGES_UNTIL_EXPORT))
    return ChartPoint(trial.capture_name, trial.label, trial.seed, *seconds, run.scores, curve)


def read_progress(field: Path) -> list[tuple[float, float, float]]:
    """Rows of `progress.csv`: seconds of learning, validation PSNR (dB) of whole image and body; empty without it.

    Raises:
        UserError: a column is missing or holds no number.
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
    """One line of chart.csv.

    steps: those of the field's training, which may end early. resumed: stages whose seconds tell only of the time after
    an interruption.
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
        "peak_rss_mib": max((manifest.peak_rss_mib for manifest in run.manifests.values()), default=None),
        "resumed": " ".join(name for name, manifest in run.manifests.items() if manifest.resumed),
        "commit": join_distinct(environment.get("commit") for environment in environments),
        "machine": join_distinct(map(_machine, environments)),
        "message": "" if run.status == "done" else run.failure,
    }


def join_distinct(texts: Iterable[str | None]) -> str:
    """The different ones among texts, in their order."""
    return "; ".join(dict.fromkeys(text for text in texts if text))


def _machine(environment: dict[str, Any]) -> str:
    parts = [environment.get("cpu"), f"{environment.get('cores')} cores", environment.get("gpu")]
    return ", ".join(part for part in parts if part)
