"""Run a trial as a process of its own, and turn how it ends into a result."""

import json
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path

from data_tools.stress.row import DONE, EXIT_CANNOT_RUN, FAILED, MISSING, REFUSED, Trial, TrialResult
from data_tools.stress.store import load_result, save_result, settings_key, trial_key
from data_tools.sweep.chart_trials import describe_machine
from data_tools.sweep.runs import last_error_message
from pipeline.core.errors import EXIT_USER_ERROR
from pipeline.core.measure import describe_environment
from pipeline.core.parent import die_with_parent_environment

WARNING_PREFIX = "warning: "
TIMEOUT_S = 3600.0
"""No trial takes so long; one that does hangs, which is a fault."""


def result_path(out: Path, trial: Trial) -> Path:
    """Return the file of the result of a trial."""
    return out / "results" / f"{trial_key(trial)}.json"


def read_trial(out: Path, trial: Trial) -> TrialResult:
    """Read the result of a trial; one of state `MISSING` if it has not run with these settings and versions."""
    return load_result(result_path(out, trial))


def read_latest(out: Path, trial: Trial, older: Mapping[str, Path]) -> TrialResult:
    """Read the result of a trial, or the newest one of earlier versions; its commit tells which.

    older: from `index_results`.
    """
    found = read_trial(out, trial)
    path = older.get(settings_key(trial.procedure, trial.settings))
    return found if found.state != MISSING or path is None else load_result(path)


def run_trial(out: Path, trial: Trial, keep: bool = False) -> TrialResult:
    """Return the result of a trial, which is run if there is none.

    If this machine lacks what the trial needs, the state is `MISSING` and the message says what; nothing is kept.

    A run folder that an interrupted sweep left is used: its finished stages are not run again.

    Args:
        out: folder of the sweep.
        keep: keep the run folder of the trial.
    """
    found = read_trial(out, trial)
    if found.state != MISSING:
        return found
    key = trial_key(trial)
    run, request, scores, log = (out / "runs" / f"{key}{suffix}" for suffix in ("", ".request", ".scores", ".log"))
    run.parent.mkdir(parents=True, exist_ok=True)
    content = {"procedure": trial.procedure, "settings": dict(trial.settings)}
    folders = {"captures": str(out / "captures"), "run": str(run)}
    request.write_text(json.dumps(content | folders), encoding="utf-8")
    scores.unlink(missing_ok=True)
    start = time.monotonic()
    code = _run_process(request, scores, log)
    result = _interpret(code, scores, log, round(time.monotonic() - start, 1), out)
    if result.state != MISSING:
        save_result(result_path(out, trial), trial, result)
    if not keep and result.state != FAILED:
        shutil.rmtree(run, ignore_errors=True)
    for path in (request, scores):
        path.unlink(missing_ok=True)
    return result


def _run_process(request: Path, scores: Path, log: Path) -> int | None:
    """Run the trial; return its exit status, None if it hung."""
    command = [sys.executable, "-m", "data_tools.stress.procedures", str(request), str(scores)]
    with log.open("w", encoding="utf-8") as file:
        try:
            done = subprocess.run(
                command,
                env=die_with_parent_environment(),
                stdout=file,
                stderr=subprocess.STDOUT,
                timeout=TIMEOUT_S,
                check=False,
            )
        except subprocess.TimeoutExpired:
            return None
    return done.returncode


def _interpret(code: int | None, scores: Path, log: Path, seconds: float, out: Path) -> TrialResult:
    environment = describe_environment()
    message = last_error_message(log).replace(str(out.resolve()), "OUT").replace(str(out), "OUT")
    numbers = {}
    if code == 0:
        state, message = DONE, ""
        document = json.loads(scores.read_text(encoding="utf-8"))
        numbers = {name: float("nan") if value is None else float(value) for name, value in document.items()}
    elif code == EXIT_USER_ERROR:
        state = REFUSED
    elif code == EXIT_CANNOT_RUN:
        state = MISSING
    else:
        state, message = FAILED, message or f"exit status {code}" if code is not None else "it hung"
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
    warnings = dict.fromkeys(line.removeprefix(WARNING_PREFIX) for line in lines if line.startswith(WARNING_PREFIX))
    return TrialResult(
        state,
        numbers,
        " ".join(message.split()),
        tuple(warnings),
        seconds,
        str(environment.get("commit") or ""),
        describe_machine(environment),
    )
