"""One writer per run folder: an exclusive `flock`, which the kernel drops when its holder dies, however it dies."""

import ctypes
import fcntl
import os
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pipeline.core.errors import UserError

LOCK_FD_VARIABLE = "AVATAR_RUN_LOCK_FD"
PARENT_PID_VARIABLE = "AVATAR_RUN_PARENT"
# A stage process whose runner was killed needs this long at most to notice and let go.
LOCK_TIMEOUT_S = 10.0


@contextmanager
def run_lock(run_dir: Path, timeout_s: float = LOCK_TIMEOUT_S) -> Iterator[int]:
    """Hold the run's lock; yield its file descriptor, which a child process may inherit.

    Inside a child of the runner the inherited lock is used. UserError when another process holds it.
    """
    path = run_dir / ".lock"
    inherited = os.environ.get(LOCK_FD_VARIABLE)
    if inherited and _is_same_file(int(inherited), path):
        yield int(inherited)
        return
    with path.open("a+") as file:
        _acquire(file.fileno(), path, timeout_s)
        file.truncate(0)
        file.write(f"{os.getpid()}\n")
        file.flush()
        yield file.fileno()


def child_environment(lock_fd: int) -> dict[str, str]:
    """Environment for a stage process that works under this process's lock."""
    return {**die_with_parent_environment(), LOCK_FD_VARIABLE: str(lock_fd)}


def die_with_parent_environment() -> dict[str, str]:
    """Environment for a child that ends with this process, if it calls `die_with_parent`."""
    return {**os.environ, PARENT_PID_VARIABLE: str(os.getpid())}


def is_runner_child() -> bool:
    """True in a process that was started by the runner, or by a program of many runs."""
    return PARENT_PID_VARIABLE in os.environ


def die_with_parent() -> None:
    """In a process with `die_with_parent_environment`: end when its parent ends, even when killed (Linux; elsewhere
    no-op).
    """
    parent = os.environ.get(PARENT_PID_VARIABLE)
    if not parent or sys.platform != "linux":
        return
    pr_set_pdeathsig = 1
    ctypes.CDLL(None).prctl(pr_set_pdeathsig, signal.SIGKILL)
    if os.getppid() != int(parent):
        os.kill(os.getpid(), signal.SIGKILL)


def _acquire(descriptor: int, path: Path, timeout_s: float) -> None:
    deadline = time.monotonic() + timeout_s
    while True:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        except BlockingIOError:
            if time.monotonic() > deadline:
                holder = path.read_text().strip() or "unknown"
                raise UserError(f"{path.parent} is in use by process {holder}: wait for it, or stop it") from None
            time.sleep(0.1)


def _is_same_file(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except OSError:
        return False
