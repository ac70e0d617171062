"""Child processes that end with the process that started them, even if it is killed."""

import ctypes
import os
import signal
import sys
import threading
import time
from pathlib import Path

PARENT_PID_VARIABLE = "AVATAR_RUN_PARENT"
_POLL_INTERVAL_S = 0.5


def die_with_parent_environment() -> dict[str, str]:
    """Return the environment for a child process that calls `die_with_parent`."""
    return {**os.environ, PARENT_PID_VARIABLE: str(os.getpid())}


def import_path_environment() -> dict[str, str]:
    """Return the variable with which an interpreter finds the modules that this process finds."""
    return {"PYTHONPATH": os.pathsep.join(str(Path(folder).absolute()) for folder in sys.path)}


def is_runner_child() -> bool:
    """Return True in a process that was started by the runner, or by a program that starts many runs."""
    return PARENT_PID_VARIABLE in os.environ


def die_with_parent() -> None:
    """End this process when its parent ends; do nothing in a process without `die_with_parent_environment`.

    Linux kills the process at once (`PR_SET_PDEATHSIG`, see prctl(2)). Elsewhere a thread waits for the parent's end.
    """
    parent = int(os.environ.get(PARENT_PID_VARIABLE, "0"))
    if not parent:
        return
    if sys.platform == "linux":
        pr_set_pdeathsig = 1
        ctypes.CDLL(None).prctl(pr_set_pdeathsig, signal.SIGKILL)
        if os.getppid() != parent:  # it ended before the call above
            os.kill(os.getpid(), signal.SIGKILL)
    else:
        threading.Thread(target=_exit_after, args=(parent,), daemon=True).start()


def _exit_after(parent: int) -> None:
    """Wait until the parent process has ended, then end this process."""
    if sys.platform == "win32":
        synchronize, infinite = 0x0010_0000, 0xFFFF_FFFF
        handle = ctypes.windll.kernel32.OpenProcess(synchronize, False, parent)
        if handle:
            ctypes.windll.kernel32.WaitForSingleObject(handle, infinite)
    else:
        while os.getppid() == parent:
            time.sleep(_POLL_INTERVAL_S)
    os._exit(1)
