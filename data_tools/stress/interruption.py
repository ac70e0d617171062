"""Interrupted runs: kill -9 at random times, a full disk, two runs on one folder; each must end with the same bytes."""

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from data_tools.stress.captures import make_capture
from data_tools.sweep.runs import TRACEBACK_HEADER
from pipeline.core.cli import EXIT_USER_ERROR
from pipeline.core.errors import UserError
from pipeline.core.manifest import read_manifest
from pipeline.core.parent import die_with_parent_environment
from stages import STAGES

PRESET = "smoke"
CAPTURE = {"frames": 32, "size": 240, "texture": 512, "novel_views": 0, "novel_poses": 0}
TIMELESS = tuple(name for name in STAGES if name != "report")
"""Stages whose bytes do not hold run times."""

FULL_DISK_MIB, LARGE_DISK_MIB = 4, 512
MIN_KILL_DELAY_S, KILL_SHARE = 1.0, 0.5
"""Least delay of a kill, and the largest as a fraction of the time of the whole run."""


def interruption_scores(captures: Path, folder: Path, kind: str, count: int) -> dict[str, float]:
    """Interrupt runs of one capture, continue them, and compare their bytes with those of an undisturbed run.

    Args:
        captures: folder of captures.
        folder: for the runs.
        kind: "kills", "full disk" or "two runs".
        count: kills.

    Returns:
        differing_files: files of the finished run that differ from those of the undisturbed one, or are missing.
        interruptions: how often the run was interrupted.

    Raises:
        UserError: the undisturbed run failed, or the machine has no small file system for "full disk".
        RuntimeError: an interrupted run did not end as it should.
    """
    video = make_capture(captures, CAPTURE, {}) / "video"
    undisturbed = captures.parent / "undisturbed"
    start = time.monotonic()
    if _start(undisturbed, video, undisturbed.with_name("undisturbed.log")).wait() != 0:
        raise UserError(f"the undisturbed run failed: see {undisturbed}.log")
    seconds = max(time.monotonic() - start, sum(m.seconds for m in map(read_manifest, _stages_of(undisturbed)) if m))
    folder.mkdir(parents=True, exist_ok=True)
    if kind == "kills":
        interruptions = _kill_at_random(folder / "run", video, seconds, count)
        found = folder / "run"
    elif kind == "two runs":
        interruptions = _run_twice_at_once(folder / "run", video)
        found = folder / "run"
    else:
        return _full_disk(folder, video, undisturbed)
    return {
        "differing_files": float(len(differing_files(undisturbed, found))),
        "interruptions": float(interruptions),
    }


def differing_files(expected: Path, found: Path) -> list[str]:
    """Return the files of finished stages that are missing, unknown or differ; of the report, only missing."""
    differing = []
    for name in STAGES:
        wanted, own = read_manifest(expected / name), read_manifest(found / name)
        files, own_files = (manifest.outputs if manifest else {} for manifest in (wanted, own))
        for file in sorted(files.keys() | own_files.keys()):
            same = files.get(file) == own_files.get(file) or (
                name not in TIMELESS and file in files and file in own_files
            )
            if not same and file != "progress.csv":
                differing.append(f"{name}/{file}")
    return differing + [path.name for path in found.glob("*.part")]


def _stages_of(run: Path) -> list[Path]:
    return [run / name for name in STAGES]


def _start(run: Path, video: Path, log: Path) -> subprocess.Popen[bytes]:
    """Start a run in a process group of its own."""
    command = [sys.executable, "-m", "stages", "--run", str(run), "--video", str(video), "--preset", PRESET]
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("ab") as file:
        return subprocess.Popen(
            command, env=die_with_parent_environment(), stdout=file, stderr=file, start_new_session=True
        )


def _kill_at_random(run: Path, video: Path, seconds: float, count: int) -> int:
    """Kill the run and continue it, `count` times at most; return the number of kills."""
    random, log, kills = np.random.default_rng(0), run.with_name("run.log"), 0
    while True:
        process = _start(run, video, log)
        delay_s = float(random.uniform(MIN_KILL_DELAY_S, KILL_SHARE * seconds)) if kills < count else None
        try:
            if process.wait(delay_s) != 0:
                raise RuntimeError(f"the run did not continue after {kills} kills: {_last_line(log)}")
            return kills
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            kills += 1


def _run_twice_at_once(run: Path, video: Path) -> int:
    """Start two runs on one folder; one must be refused in one sentence, or wait. Return how many were refused."""
    logs = [run.with_name(f"{number}.log") for number in range(2)]
    processes = [_start(run, video, log) for log in logs]
    codes = [process.wait() for process in processes]
    for code, log in zip(codes, logs, strict=True):
        text = log.read_text(encoding="utf-8", errors="replace")
        if code not in (0, EXIT_USER_ERROR) or TRACEBACK_HEADER in text:
            raise RuntimeError(f"a second run ended with status {code}: {_last_line(log)}")
    if _start(run, video, logs[0]).wait() != 0:
        raise RuntimeError(f"the run does not continue after two at once: {_last_line(logs[0])}")
    return codes.count(EXIT_USER_ERROR)


def _full_disk(folder: Path, video: Path, undisturbed: Path) -> dict[str, float]:
    with _small_disk(folder / "disk", FULL_DISK_MIB) as disk:
        log = folder / "run.log"
        code = _start(disk / "run", video, log).wait()
        text = log.read_text(encoding="utf-8", errors="replace")
        if code != EXIT_USER_ERROR or "disk is full" not in text or TRACEBACK_HEADER in text:
            raise RuntimeError(f"a full disk ended the run with status {code}: {_last_line(log)}")
        _command(["mount", "-o", f"remount,size={LARGE_DISK_MIB}M", str(disk)])
        if _start(disk / "run", video, log).wait() != 0:
            raise RuntimeError(f"the run does not continue on a larger disk: {_last_line(log)}")
        return {"differing_files": float(len(differing_files(undisturbed, disk / "run"))), "interruptions": 1.0}


@contextmanager
def _small_disk(folder: Path, size_mib: int) -> Iterator[Path]:
    """Mount a small file system in memory. UserError where this is not allowed."""
    folder.mkdir(parents=True, exist_ok=True)
    if sys.platform != "linux" or not shutil.which("mount"):
        raise UserError("the trial `full disk` needs Linux's mount")
    try:
        _command(["mount", "-t", "tmpfs", "-o", f"size={size_mib}M", "tmpfs", str(folder)])
    except subprocess.CalledProcessError:
        raise UserError("the trial `full disk` mounts a small file system: run it as root") from None
    try:
        yield folder
    finally:
        _command(["umount", str(folder)])


def _command(command: Sequence[str]) -> None:
    subprocess.run(command, check=True, capture_output=True)


def _last_line(log: Path) -> str:
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
    return lines[-1] if lines else "no message"
