"""Cost and environment of a run: peak memory, processor, packages, commit. Recorded, never used for freshness."""

import os
import platform
import re
import subprocess
import sys
from functools import cache
from importlib.metadata import distributions
from pathlib import Path
from typing import Any

if sys.platform != "win32":
    import resource

REPOSITORY_DIR = Path(__file__).resolve().parents[2]
"""Root of the checkout; in an installation, the folder that holds the packages."""

MIB = 1024.0 * 1024.0


def peak_rss_mib() -> float:
    """Return the peak resident memory so far, in MiB: of this process or its largest finished child process.

    Windows reports no children.
    """
    if sys.platform == "win32":
        return _windows_peak_rss_mib()
    # On Linux not the value of getrusage: it includes the memory of the parent at the time of the fork.
    own = _linux_peak_rss_mib()
    return max(_maxrss_mib(resource.RUSAGE_SELF) if own is None else own, _maxrss_mib(resource.RUSAGE_CHILDREN))


def describe_environment() -> dict[str, Any]:
    """Return commit, Python, packages, processor, cores and GPU of this process, as JSON values."""
    return {
        "commit": _commit(REPOSITORY_DIR),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cpu": cpu_name(),
        "cores": os.cpu_count(),
        "gpu": _gpu_name(),
        "packages": dict(_packages()),
    }


def cpu_name() -> str:
    """Return the model name of the processor, or its architecture where the system does not report the model."""
    cpuinfo = Path("/proc/cpuinfo")
    found = re.search(r"^model name\s*:\s*(.+)$", cpuinfo.read_text(), re.MULTILINE) if cpuinfo.exists() else None
    return found.group(1) if found else platform.processor() or platform.machine()


def _linux_peak_rss_mib() -> float | None:
    """Return VmHWM of this process, see proc_pid_status(5); None on other systems."""
    path = Path("/proc/self/status")
    found = re.search(r"^VmHWM:\s+(\d+) kB", path.read_text(), re.MULTILINE) if path.exists() else None
    return int(found.group(1)) * 1024 / MIB if found else None


if sys.platform == "win32":

    def _windows_peak_rss_mib() -> float:
        """Return PeakWorkingSetSize of this process (GetProcessMemoryInfo)."""
        import ctypes
        from ctypes import wintypes

        class ProcessMemoryCounters(ctypes.Structure):
            _fields_ = (
                ("cb", wintypes.DWORD),
                ("PageFaultCount", wintypes.DWORD),
                ("PeakWorkingSetSize", ctypes.c_size_t),
                *((f"unused{number}", ctypes.c_size_t) for number in range(7)),
            )

        counters = ProcessMemoryCounters(cb=ctypes.sizeof(ProcessMemoryCounters))
        process = wintypes.HANDLE(ctypes.windll.kernel32.GetCurrentProcess())
        ctypes.windll.kernel32.K32GetProcessMemoryInfo(process, ctypes.byref(counters), counters.cb)
        return counters.PeakWorkingSetSize / MIB

else:

    def _maxrss_mib(who: int) -> float:
        unit_bytes = 1 if sys.platform == "darwin" else 1024
        return resource.getrusage(who).ru_maxrss * unit_bytes / MIB


@cache
def _packages() -> tuple[tuple[str, str], ...]:
    return tuple(sorted((d.metadata["Name"], d.version) for d in distributions()))


@cache
def _commit(repository: Path) -> str | None:
    """Return the checked-out commit, with `+` when files differ from it; None outside a checkout of this project."""
    if not (repository / ".git").exists():
        return None
    describe = ["git", "-C", str(repository), "describe", "--always", "--abbrev=40", "--dirty=+", "--exclude=*"]
    try:
        done = subprocess.run(describe, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        return None
    return done.stdout.strip() or None


def _gpu_name() -> str | None:
    """Return the name of the first CUDA device if the stage has loaded torch; this module does not load it.

    None also for a GPU that refuses access, for instance in exclusive mode: the finished work is worth more.
    """
    torch = sys.modules.get("torch")
    try:
        return str(torch.cuda.get_device_name(0)) if torch and torch.cuda.is_available() else None
    except RuntimeError:
        return None
