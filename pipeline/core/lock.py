"""Exclusive lock of a run folder: one writer at a time.

The lock is an operating-system lock on the open file `.lock` (`flock` on POSIX, `LockFileEx` on Windows), which the
system releases when its holder dies. A stage process inherits the open file from the runner on POSIX, so the folder
stays locked until both have ended. Windows cannot pass the file on; there the runner passes its path.
"""

import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from filelock import lock_descriptor

from pipeline.core.errors import UserError
from pipeline.core.parent import die_with_parent_environment

LOCK_FILE = ".lock"
LOCK_FD_VARIABLE = "AVATAR_RUN_LOCK_FD"
LOCK_PATH_VARIABLE = "AVATAR_RUN_LOCK"
LOCK_TIMEOUT_S = 10.0
"""Time that a stage process needs at most to notice that its runner was killed."""

_POLL_INTERVAL_S = 0.1
# Windows locks byte 0 against reading, so the holder's process id starts at byte 1.
_PID_OFFSET = 1


@dataclass(frozen=True)
class RunLock:
    """A lock that this process holds or has inherited: the lock file and its open descriptor."""

    path: Path
    descriptor: int

    @property
    def passed_descriptors(self) -> tuple[int, ...]:
        """Descriptors that a child process inherits (`pass_fds` of `subprocess`)."""
        return () if sys.platform == "win32" else (self.descriptor,)

    def child_environment(self) -> dict[str, str]:
        """Environment of a stage process that works under this lock and ends with this process."""
        inherited = {LOCK_PATH_VARIABLE: str(self.path.resolve()), LOCK_FD_VARIABLE: str(self.descriptor)}
        return die_with_parent_environment() | inherited


@contextmanager
def run_lock(run_dir: Path, timeout_s: float = LOCK_TIMEOUT_S) -> Iterator[RunLock]:
    """Hold the lock of a run folder, or use the one that the runner has passed to this process.

    Raises:
        UserError: another process still holds the lock after `timeout_s` seconds.
    """
    path = run_dir / LOCK_FILE
    inherited = os.environ.get(LOCK_FD_VARIABLE)
    if inherited and _is_inherited(int(inherited), path):
        yield RunLock(path, int(inherited))
        return
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT)
    try:
        _acquire(descriptor, path, timeout_s)
        os.ftruncate(descriptor, 0)
        os.write(descriptor, b" " * _PID_OFFSET + str(os.getpid()).encode())
        yield RunLock(path, descriptor)
    finally:
        os.close(descriptor)


def _acquire(descriptor: int, path: Path, timeout_s: float) -> None:
    deadline = time.monotonic() + timeout_s
    while not lock_descriptor(descriptor, blocking=False):
        if time.monotonic() > deadline:
            raise UserError(f"{path.parent} is in use by process {_read_holder(path)}: wait for it, or stop it")
        time.sleep(_POLL_INTERVAL_S)


def _read_holder(path: Path) -> str:
    with path.open("rb", buffering=0) as file:
        file.seek(_PID_OFFSET)
        return file.read(32).decode(errors="replace").strip() or "unknown"


def _is_inherited(descriptor: int, path: Path) -> bool:
    """Return True if the runner has locked just this lock file for this process."""
    try:
        if sys.platform == "win32":
            return os.path.samefile(os.environ.get(LOCK_PATH_VARIABLE, ""), path)
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except OSError:
        return False
