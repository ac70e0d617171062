"""Interrupted runs: kill -9 at random times, a full disk, two runs on one folder; each must end with the same bytes.

A kill may destroy at most `MAX_LOST_S` of work. Work is counted in CPU seconds, see `data_tools.stress.lost_work`. The
undisturbed run has as many threads as the others: the last digits of the fitted body depend on their number.
"""

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from data_tools.stress.captures import make_capture
from data_tools.stress.lost_work import LostWork, wait_and_watch
from data_tools.stress.row import CannotRunError
from data_tools.sweep.runs import TRACEBACK_HEADER
from pipeline.core.errors import EXIT_USER_ERROR, UserError
from pipeline.core.manifest import read_manifest
from pipeline.core.parent import die_with_parent_environment
from stages import STAGES

PRESET = "smoke"
CAPTURE = {"frames": 32, "size": 240, "texture": 512, "novel_views": 0, "novel_poses": 0}
TIMELESS = tuple(name for name in STAGES if name != "report")
"""Stages whose bytes do not hold run times."""

FULL_DISK_MIB, LARGE_DISK_MIB = 4, 512
EXTRA_KILLS = 3
"""Kills of a trial beyond one in each stage, in random stages."""

MAX_LOST_S = 20.0
"""Work that a kill may destroy, CPU seconds."""


@dataclass
class KillLog:
    """What the kills of a trial did.

    stages: the stage that each kill met. lost_s: CPU seconds that each destroyed. cpu_s: of all runs together, with
    those that were killed. differing: files of the finished runs that differ. runs: finished runs.
    """

    stages: list[str] = field(default_factory=list)
    lost_s: list[float] = field(default_factory=list)
    cpu_s: float = 0.0
    differing: int = 0
    runs: int = 0

    def scores(self, undisturbed_cpu_s: float) -> dict[str, float]:
        """Return the scores of `interruption_scores`; nan for seconds without a kill."""
        count = len(self.stages)
        extra_s = self.cpu_s - self.runs * undisturbed_cpu_s
        return {
            "differing_files": float(self.differing),
            "interruptions": float(count),
            "repeated_seconds": max(self.lost_s, default=float("nan")),
            "extra_seconds_a_kill": extra_s / count if count else float("nan"),
            **{f"kills_in_{name}": float(self.stages.count(name)) for name in STAGES},
            **{
                f"repeated_in_{name}": max(
                    lost for stage, lost in zip(self.stages, self.lost_s, strict=True) if stage == name
                )
                for name in dict.fromkeys(self.stages)
            },
        }


def interruption_scores(
    captures: Path, folder: Path, kind: str, count: int = 1, seed: int = 0, threads: int | None = None
) -> dict[str, float]:
    """Interrupt runs of one capture, continue them, and compare their bytes with those of an undisturbed run.

    Args:
        captures: folder of captures.
        folder: for the runs.
        kind: "kills", "full disk" or "two runs".
        count: interruptions of the kinds that are not kills, which are one.
        seed: of the times of the kills: one at a random time in each stage, and `EXTRA_KILLS` in random stages.
        threads: of all runs; None: as the environment says. It is set for this process, which runs nothing else.

    Returns:
        differing_files: files of the finished runs that differ from those of the undisturbed one, or are missing.
        interruptions: how often a run was interrupted.
        repeated_seconds: of kills: the most work that one of them destroyed, CPU seconds since the last checkpoint or
            the last finished stage.
        repeated_in_STAGE: the same in each stage that was killed. kills_in_STAGE: their number.
        extra_seconds_a_kill: CPU seconds beyond those of undisturbed runs over the kills; with the start of the program
            and the preparation of the stage, which are repeated as well.

    Raises:
        UserError: the undisturbed run failed.
        CannotRunError: the machine has no small file system for "full disk".
        RuntimeError: an interrupted run did not end as it should.
    """
    video = make_capture(captures, CAPTURE, {}) / "video"
    if threads is not None:
        os.environ |= {name: str(threads) for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS")}
    undisturbed = captures.parent / f"undisturbed-{os.environ.get('OMP_NUM_THREADS', 'all')}-threads"
    cpu_s = _run_undisturbed(undisturbed, video)
    folder.mkdir(parents=True, exist_ok=True)
    if kind == "kills":
        return _kill_at_random(folder, video, undisturbed, kill_times(undisturbed, seed)).scores(cpu_s)
    if kind == "two runs":
        refused = _run_twice_at_once(folder / "run", video)
        return {
            "differing_files": float(len(differing_files(undisturbed, folder / "run"))),
            "interruptions": float(refused),
        }
    return _full_disk(folder, video, undisturbed)


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


def _start(run: Path, video: Path, log: Path) -> subprocess.Popen[bytes]:
    """Start a run in a process group of its own."""
    command = [sys.executable, "-m", "stages", "--run", str(run), "--video", str(video), "--preset", PRESET]
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("ab") as file:
        return subprocess.Popen(
            command, env=die_with_parent_environment(), stdout=file, stderr=file, start_new_session=True
        )


def _run_undisturbed(run: Path, video: Path) -> float:
    """Make the run that nothing disturbs, once for all trials; return its CPU seconds.

    UserError if it failed.
    """
    cost, log = run.with_name(f"{run.name}.cpu_s"), run.with_name(f"{run.name}.log")
    if not cost.exists():  # of a run that was interrupted, a part of the cost is not known
        shutil.rmtree(run, ignore_errors=True)
    process = _start(run, video, log)
    watch = LostWork(run, process.pid)
    wait_and_watch(process, watch, None)
    if process.returncode != 0:
        raise UserError(f"the undisturbed run failed: see {log}")
    if not cost.exists():
        cost.write_text(f"{watch.cpu_s:.2f}", encoding="utf-8")
    return float(cost.read_text(encoding="utf-8"))


@dataclass
class KillTime:
    """A time of a kill: `delay_s` after a stage, or a later one, has begun."""

    stage: str
    delay_s: float
    _begin_s: float | None = field(default=None, init=False)

    def has_come(self, run: Path) -> bool:
        """Return whether the time has come; to be asked again and again."""
        later = STAGES[STAGES.index(self.stage) :]
        if self._begin_s is None and any((run / name).exists() or (run / f"{name}.part").exists() for name in later):
            self._begin_s = time.monotonic()
        return self._begin_s is not None and time.monotonic() - self._begin_s >= self.delay_s


def kill_times(undisturbed: Path, seed: int) -> list[KillTime]:
    """Return random times in each stage and `EXTRA_KILLS` more, by the seconds of the undisturbed run, in order."""
    random = np.random.default_rng(seed)
    chosen = [*range(len(STAGES)), *random.integers(len(STAGES), size=EXTRA_KILLS)]
    seconds = [manifest.seconds if (manifest := read_manifest(undisturbed / name)) else 0.0 for name in STAGES]
    return [KillTime(STAGES[index], float(random.uniform(0.0, seconds[index]))) for index in sorted(chosen)]


def _kill_at_random(folder: Path, video: Path, undisturbed: Path, times: Sequence[KillTime]) -> KillLog:
    """Kill runs and continue them until all times have come and the last run has ended."""
    found, left = KillLog(), list(times)
    while found.runs == 0 or left:
        run = folder / f"run{found.runs}"
        shutil.rmtree(run, ignore_errors=True)
        _kill_until_done(run, video, found, left)
        found.differing += len(differing_files(undisturbed, run))
        found.runs += 1
    return found


def _kill_until_done(run: Path, video: Path, found: KillLog, left: list[KillTime]) -> None:
    """Kill one run and continue it until it has ended; `left` keeps the times that did not come."""
    log = run.with_name(f"{run.name}.log")
    while True:
        process = _start(run, video, log)
        watch = LostWork(run, process.pid)
        ended = wait_and_watch(process, watch, partial(left[0].has_come, run) if left else None)
        if ended and process.returncode != 0:
            raise RuntimeError(f"the run did not continue after {len(found.stages)} kills: {_last_line(log)}")
        if not ended:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        found.cpu_s += watch.cpu_s
        if ended:
            return
        left.pop(0)
        found.stages.append(next((name for name in STAGES if not (run / name).exists()), "end"))
        found.lost_s.append(watch.lost_s)


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
    """Mount a small file system in memory. CannotRunError where this is not allowed."""
    folder.mkdir(parents=True, exist_ok=True)
    if sys.platform != "linux" or not shutil.which("mount"):
        raise CannotRunError("the trial `full disk` needs Linux's mount")
    try:
        _command(["mount", "-t", "tmpfs", "-o", f"size={size_mib}M", "tmpfs", str(folder)])
    except subprocess.CalledProcessError:
        raise CannotRunError("the trial `full disk` mounts a small file system: run it as root") from None
    try:
        yield folder
    finally:
        _command(["umount", str(folder)])


def _command(command: Sequence[str]) -> None:
    subprocess.run(command, check=True, capture_output=True)


def _last_line(log: Path) -> str:
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
    return lines[-1] if lines else "no message"
