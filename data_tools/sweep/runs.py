"""Many runs of the pipeline: each is started as a command of its own, and its folder tells how far it came."""

import csv
import json
import os
import subprocess
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import Any

import stages
from data_tools.evaluate.files import TRUTH_FILES, TRUTH_VERSION
from pipeline.core.atomic import atomic_path
from pipeline.core.config import parse_overrides
from pipeline.core.errors import UserError
from pipeline.core.manifest import Manifest, digest_file, read_manifest
from pipeline.core.parent import die_with_parent_environment
from pipeline.core.record import RunRecord, read_record
from pipeline.core.status import FRESH, stage_states

ERROR_PREFIX = "error: "
TRACEBACK_HEADER = "Traceback (most recent call last):"

# Column of a table, the document below report/, and where the figure stands in it.
SCORE_PATHS = {
    "field_psnr_full_db": ("report.json", "heldout", "field", "psnr_full"),
    "field_psnr_body_db": ("report.json", "heldout", "field", "psnr_body"),
    "mesh_psnr_full_db": ("report.json", "heldout", "mesh", "psnr_full"),
    "mesh_psnr_body_db": ("report.json", "heldout", "mesh", "psnr_body"),
    "chamfer_mm": ("truth.json", "mesh", "chamfer_mm"),
}


@dataclass(frozen=True)
class RunState:
    """What a run folder tells.

    states: of every stage in order, the words of `python -m stages --status`.
    manifests: of the fresh stages.
    scores: the `SCORE_PATHS` that a fresh report holds.
    failure: the sentence with which the last command ended badly; empty when it did not.
    """

    states: dict[str, str]
    manifests: dict[str, Manifest]
    scores: dict[str, float]
    failure: str

    @property
    def status(self) -> str:
        """done, failed, or unfinished."""
        if all(state == FRESH for state in self.states.values()):
            return "done"
        return "failed" if self.failure else "unfinished"

    def seconds(self, names: Sequence[str]) -> float:
        """What the fresh ones of these stages took together."""
        return sum((self.manifests[name].seconds for name in names if name in self.manifests), 0.0)


def read_run(run_dir: Path, record: RunRecord | None = None) -> RunState:
    """Look at a run; what its folder does not hold is missing.

    A damaged record or an unknown option counts as failure of this run, so that the others are still told.

    Args:
        record: what the run should be of: what was made otherwise is not fresh. The folder's own when None.
    """
    failure = last_error_message(log_path(run_dir))
    try:
        states = _states(run_dir, record)
    except UserError as error:
        states, failure = dict.fromkeys(stages.STAGES, "missing"), str(error)
    found = {name: read_manifest(run_dir / name) for name, state in states.items() if state == FRESH}
    manifests = {name: manifest for name, manifest in found.items() if manifest}
    is_done = len(manifests) == len(states)
    return RunState(states, manifests, read_scores(run_dir / "report") if is_done else {}, failure)


def reusable_stages(run_dir: Path, record: RunRecord) -> list[str]:
    """The first stages of a folder, in order, that a run with this record would take over as they are."""
    states = stage_states(stages.PIPELINE, run_dir, record)
    return list(takewhile(lambda name: states[name] == FRESH, states))


def find_video(path: Path) -> Path:
    """The video of a synthetic capture, which lies beside its truth; any other path is one itself."""
    return path / "video" if (path / "video").is_dir() else path


def validate_run_options(preset: str, assignments: Sequence[str]) -> None:
    """Refuse an unknown preset or option with one UserError, before any run starts."""
    stages.PIPELINE.build_configs(RunRecord(preset=preset, overrides=parse_overrides(assignments)))


def start_run(run_dir: Path, arguments: Sequence[str], threads: int | None = None) -> None:
    """`python -m stages --run RUN_DIR ARGUMENTS` to its end, good or bad, with all it says in `log_path`.

    It ends when this process ends, however that happens. threads: for each of the numeric libraries, unless the user's
    environment says; None leaves the choice to them.
    """
    run_dir.parent.mkdir(parents=True, exist_ok=True)
    limits = {name: str(threads) for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS") if threads is not None}
    command = [sys.executable, "-m", "stages", "--run", str(run_dir), *arguments]
    with log_path(run_dir).open("w", encoding="utf-8") as log:
        subprocess.run(
            command, env=limits | die_with_parent_environment(), stdout=log, stderr=subprocess.STDOUT, check=False
        )


def log_path(run_dir: Path) -> Path:
    """RUN.log, beside the folder: a run that fails at once takes its folder away."""
    return run_dir.with_name(f"{run_dir.name}.log")


def last_error_message(log: Path) -> str:
    """The sentence after `error:`, or the last line of a traceback; empty where the log tells of no failure."""
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines() if log.is_file() else []
    error_lines = [line.removeprefix(ERROR_PREFIX) for line in lines if line.startswith(ERROR_PREFIX)]
    if error_lines:
        return error_lines[-1]
    return lines[-1] if TRACEBACK_HEADER in lines else ""


def read_scores(report: Path) -> dict[str, float]:
    """The `SCORE_PATHS` that stand in a report's folder; what is absent or null is left out."""
    documents = {name: _read_json(report / name) for name, *_ in SCORE_PATHS.values()}
    scores = {}
    for column, (name, *keys) in SCORE_PATHS.items():
        value: Any = documents[name]
        for key in keys:
            value = value.get(key) if isinstance(value, dict) else None
        if isinstance(value, int | float):
            scores[column] = float(value)
    return scores


def has_current_comparison(report: Path) -> bool:
    """Whether a report holds a comparison with the truth of this version, whole: one that was cut short is none."""
    manifest = read_manifest(report)
    known = manifest.outputs if manifest else {}
    if any(not (report / name).is_file() or digest_file(report / name) != known.get(name) for name in TRUTH_FILES):
        return False
    return bool(_read_json(report / "truth.json").get("version") == TRUTH_VERSION)


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """A table with a line of headings, whole or not at all."""
    with atomic_path(path) as unfinished, unfinished.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([columns, *rows])


def cpu_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _states(run_dir: Path, record: RunRecord | None) -> dict[str, str]:
    return stage_states(stages.PIPELINE, run_dir, record or read_record(run_dir))


def _read_json(path: Path) -> Any:
    """The document; an empty one where it is absent or damaged."""
    try:
        return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    except ValueError:
        return {}
