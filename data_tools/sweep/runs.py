"""Start runs of the pipeline as separate processes, and read their state from the run folders."""

import csv
import json
import os
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import Any

import stages
from data_tools.evaluate.files import load_comparison_scores
from pipeline.core.atomic import atomic_path
from pipeline.core.config import parse_overrides
from pipeline.core.errors import UserError
from pipeline.core.manifest import Manifest, read_manifests
from pipeline.core.parent import die_with_parent_environment
from pipeline.core.record import RunRecord, read_record
from pipeline.core.run_folder import RunRequest
from pipeline.core.status import FRESH, stage_states

ERROR_PREFIX = "error: "
TRACEBACK_HEADER = "Traceback (most recent call last):"

REPORT, COMPARISON = "report", "comparison"

# Column of the tables, document, and path of the score in the document.
SCORE_PATHS = {
    "field_psnr_full_db": (REPORT, "heldout", "field", "psnr_full"),
    "field_psnr_body_db": (REPORT, "heldout", "field", "psnr_body"),
    "mesh_psnr_full_db": (REPORT, "heldout", "mesh", "psnr_full"),
    "mesh_psnr_body_db": (REPORT, "heldout", "mesh", "psnr_body"),
    "chamfer_mm": (COMPARISON, "mesh_matched", "chamfer_mm"),
    "normal_angle_deg": (COMPARISON, "mesh_matched", "normal_angle_deg"),
}
"""Distances are those in the A-pose after the rigs are matched, so that they compare surfaces, not places of joints."""


@dataclass(frozen=True)
class RunState:
    """State of a run folder.

    Attributes:
        states: of each stage in order, as in `python -m stages --status`.
        manifests: of the fresh stages.
        scores: by column of `SCORE_PATHS`, if the run is finished.
        failure: error message of the last command; empty if it succeeded.
    """

    states: dict[str, str]
    manifests: dict[str, Manifest]
    scores: dict[str, float]
    failure: str

    @property
    def status(self) -> str:
        """One of done, failed, unfinished."""
        if all(state == FRESH for state in self.states.values()):
            return "done"
        return "failed" if self.failure else "unfinished"

    def seconds(self, names: Sequence[str]) -> float:
        """Return the total run time of the fresh stages among `names`."""
        return sum((self.manifests[name].seconds for name in names if name in self.manifests), 0.0)


def read_run(run_dir: Path, record: RunRecord | None = None, request: RunRequest | None = None) -> RunState:
    """Read the state of a run; a run without a folder has only missing stages.

    A damaged record, an unknown option, another video or a file that cannot be opened is returned as the failure of
    this run, so that other runs can be read.

    Args:
        record: expected video and options, with which stages must agree to be fresh; default: that of the folder.
        request: a command that changes the record: stages must agree with what it asks for, even if it was refused.
    """
    failure = last_error_message(log_path(run_dir))
    try:
        states = _states(run_dir, record, request)
    except (UserError, OSError) as error:
        states, failure = dict.fromkeys(stages.STAGES, "missing"), str(error)
    manifests = read_manifests(run_dir, [name for name, state in states.items() if state == FRESH])
    is_done = len(manifests) == len(states)
    return RunState(states, manifests, read_scores(run_dir) if is_done else {}, failure)


def reusable_stages(run_dir: Path, record: RunRecord) -> list[str]:
    """Return the leading stages of a run folder that are fresh for another record."""
    states = stage_states(stages.PIPELINE, run_dir, record)
    return list(takewhile(lambda name: states[name] == FRESH, states))


def find_video(path: Path) -> Path:
    """Return the video of a synthetic capture; other paths are returned unchanged."""
    return path / "video" if (path / "video").is_dir() else path


def validate_run_options(preset: str, assignments: Sequence[str]) -> None:
    """Raise UserError for an unknown preset or option."""
    stages.PIPELINE.build_configs(RunRecord(preset=preset, overrides=parse_overrides(assignments)))


def start_run(run_dir: Path, arguments: Sequence[str], threads: int | None = None) -> None:
    """Run `python -m stages --run RUN_DIR ARGUMENTS` and wait; its output goes to `log_path`. Failures do not raise.

    The run ends when this process ends, even if it is killed.

    Args:
        threads: of each numeric library, unless the environment sets it; None is the default of the libraries.
    """
    run_dir.parent.mkdir(parents=True, exist_ok=True)
    limits = {name: str(threads) for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS") if threads is not None}
    command = [sys.executable, "-m", "stages", "--run", str(run_dir), *arguments]
    with log_path(run_dir).open("w", encoding="utf-8") as log:
        subprocess.run(
            command, env=limits | die_with_parent_environment(), stdout=log, stderr=subprocess.STDOUT, check=False
        )


def log_path(run_dir: Path) -> Path:
    """Return RUN.log, next to the run folder, which a run that fails immediately removes."""
    return run_dir.with_name(f"{run_dir.name}.log")


def last_error_message(log: Path) -> str:
    """Return the message after `error:`, or the last line of a traceback; empty if the log has no failure."""
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines() if log.is_file() else []
    error_lines = [line.removeprefix(ERROR_PREFIX) for line in lines if line.startswith(ERROR_PREFIX)]
    if error_lines:
        return error_lines[-1]
    return lines[-1] if TRACEBACK_HEADER in lines else ""


def read_scores(run_dir: Path) -> dict[str, float]:
    """Read the scores of `SCORE_PATHS` of a run; absent and null scores are left out."""
    documents = {
        REPORT: _read_json(run_dir / "report" / "report.json"),
        COMPARISON: load_comparison_scores(run_dir) or {},
    }
    return pick_numbers(documents, SCORE_PATHS)


def pick_numbers(documents: Mapping[str, Any], paths: Mapping[str, Sequence[str]]) -> dict[str, float]:
    """Return the number at each path (document, then keys) by column; absent and null ones are left out."""
    numbers = {}
    for column, (name, *keys) in paths.items():
        value: Any = documents[name]
        for key in keys:
            value = value.get(key) if isinstance(value, dict) else None
        if isinstance(value, int | float):
            numbers[column] = float(value)
    return numbers


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Write a table with a header row, atomically."""
    with atomic_path(path) as unfinished, unfinished.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([columns, *rows])


def cpu_cores() -> int:
    """Return the number of CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _states(run_dir: Path, record: RunRecord | None, request: RunRequest | None) -> dict[str, str]:
    record = record or read_record(run_dir)
    return stage_states(stages.PIPELINE, run_dir, request.apply(record) if request else record)


def _read_json(path: Path) -> Any:
    """Return the document; empty if it is absent or damaged."""
    try:
        return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    except ValueError:
        return {}
