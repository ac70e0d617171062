"""Results of trials as JSON files, keyed by everything that determines them."""

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import stages
from data_tools.stress.row import MISSING, Trial, TrialResult
from data_tools.synthetic.scene.capture import CAPTURE_VERSION
from pipeline.core.atomic import atomic_path
from pipeline.core.manifest import digest_file, digest_json

STRESS_VERSION = 1
"""Raised when equal settings of a procedure measure something else."""

PRESET_FILE = Path(__file__).with_name("preset.yaml")


def trial_key(trial: Trial, preset: Path = PRESET_FILE) -> str:
    """Digest settings, preset and the versions of captures, stages and measures; equal keys have equal results."""
    versions = {name: stages.load_stage(name).version for name in stages.STAGES}
    return digest_json(
        {
            "procedure": trial.procedure,
            "settings": dict(trial.settings),
            "preset": digest_file(preset),
            "versions": versions,
            "capture": CAPTURE_VERSION,
            "stress": STRESS_VERSION,
        }
    )[:16]


def save_result(path: Path, trial: Trial, result: TrialResult) -> None:
    """Write a result and the trial that it belongs to."""
    path.parent.mkdir(parents=True, exist_ok=True)
    document: dict[str, Any] = {"procedure": trial.procedure, "settings": dict(trial.settings), **asdict(result)}
    document["scores"] = {name: _json_number(value) for name, value in result.scores.items()}
    with atomic_path(path) as part:
        part.write_text(json.dumps(document, indent=2, sort_keys=True, allow_nan=False) + "\n", encoding="utf-8")


def load_result(path: Path) -> TrialResult:
    """Read a result; one of state `MISSING` if there is none, or a damaged one."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        scores = {name: float("nan") if value is None else float(value) for name, value in document["scores"].items()}
        return TrialResult(
            document["state"],
            scores,
            document["message"],
            tuple(document["warnings"]),
            document["seconds"],
            document["commit"],
            document["machine"],
        )
    except (OSError, ValueError, LookupError, TypeError):
        return TrialResult(MISSING)


def index_results(folder: Path) -> dict[str, Path]:
    """Return the newest result file of each trial, whatever preset and versions it is of, by `settings_key`.

    folder: of the results. Damaged files are left out.
    """
    newest: dict[str, Path] = {}
    for path in sorted(folder.glob("*.json"), key=lambda path: path.stat().st_mtime):
        try:
            document = json.loads(path.read_text(encoding="utf-8"))
            newest[settings_key(document["procedure"], document["settings"])] = path
        except (ValueError, LookupError, TypeError):
            continue
    return newest


def settings_key(procedure: str, settings: Mapping[str, Any]) -> str:
    """Digest what a trial does, without preset and versions."""
    return digest_json({"procedure": procedure, "settings": dict(settings)})


def _json_number(value: float) -> float | None:
    return float(value) if abs(float(value)) < float("inf") else None
