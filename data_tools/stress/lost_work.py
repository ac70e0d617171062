"""Work that a kill destroys: CPU seconds of a run since the last moment from which it continues.

Such moments are the end of a stage and each checkpoint. CPU seconds, unlike seconds, do not depend on what else the
machine does. A poll sees a moment up to `POLL_INTERVAL_S` late, by which the lost work is too small at most.
"""

import os
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from pipeline.core.manifest import MANIFEST_FILE, PROGRESS_FILE
from pipeline.core.stage import CHECKPOINT_PREFIX

POLL_INTERVAL_S = 0.25
_PROC = Path("/proc")


@dataclass
class LostWork:
    """CPU seconds of a run in a process group of its own, and how many of them a kill would destroy.

    run: the run folder. group: the process group.
    """

    run: Path
    group: int
    cpu_s: float = 0.0
    _kept_cpu_s: float = field(default=0.0, init=False)
    _kept: frozenset[tuple[str, int]] = field(default=frozenset(), init=False)

    def __post_init__(self) -> None:
        self._kept = kept_files(self.run)

    @property
    def lost_s(self) -> float:
        """CPU seconds since the last kept file, or since the start."""
        return self.cpu_s - self._kept_cpu_s

    def poll(self) -> None:
        """Read the clock of the processes and the kept files."""
        self.cpu_s = max(self.cpu_s, group_cpu_s(self.group))
        kept = kept_files(self.run)
        if kept != self._kept:
            self._kept, self._kept_cpu_s = kept, self.cpu_s


def wait_and_watch(process: "subprocess.Popen[bytes]", watch: LostWork, until: Callable[[], bool] | None) -> bool:
    """Wait for the end of a process, or until a condition holds, and watch its work; return whether it ended."""
    while process.poll() is None:
        watch.poll()
        if until is not None and until():
            return False
        time.sleep(POLL_INTERVAL_S)
    return True


def kept_files(run: Path) -> frozenset[tuple[str, int]]:
    """Return the files from which a run continues after a kill, with their modification times in ns.

    These are the manifests of finished stages and the checkpoints, without that of the progress curve.
    """
    found = set()
    for path in [*run.glob(f"*/{MANIFEST_FILE}"), *run.glob(f"*.part/{CHECKPOINT_PREFIX}*")]:
        if path.name.endswith(PROGRESS_FILE) or (path.name == MANIFEST_FILE and path.parent.suffix == ".part"):
            continue
        try:
            found.add((path.relative_to(run).as_posix(), path.stat().st_mtime_ns))
        except FileNotFoundError:  # renamed since it was listed
            continue
    return frozenset(found)


def group_cpu_s(group: int) -> float:
    """Return the CPU seconds of all processes of a group and of their children that have ended (Linux; else 0)."""
    ticks = 0
    for folder in _PROC.glob("[0-9]*"):
        try:
            # Fields after the name, which may hold spaces: state is 0, group is 2, the four times are 11 to 14.
            fields = (folder / "stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
        except (FileNotFoundError, ProcessLookupError):
            continue
        if int(fields[2]) == group:
            ticks += sum(map(int, fields[11:15]))
    return ticks / os.sysconf("SC_CLK_TCK")
