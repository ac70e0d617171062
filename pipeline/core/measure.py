"""What a run cost and where it ran: peak memory, processor, packages, commit. Recorded, never used for freshness."""

import os
import platform
import re
import resource
import subprocess
import sys
from collections.abc import Iterable
from importlib.metadata import distributions
from pathlib import Path
from typing import Any

REPOSITORY_DIR = Path(__file__).resolve().parents[2]
MIB = 1024.0 * 1024.0


_worker_peaks_mib: dict[int, float] = {}


def record_worker_peaks(pids: Iterable[int]) -> None:
    """Add the peaks of these processes to `peak_rss_mib`; call it at the end of their work, while they still live."""
    _worker_peaks_mib.update({pid: peak for pid in pids if (peak := _process_peak_rss_mib(str(pid))) is not None})


def peak_rss_mib() -> float:
    """Highest resident memory so far, in MiB: this process's and the peaks of the workers that were counted.

    More than was held at once where the peaks did not coincide, and pages that processes share count for each. At
    least what the largest finished child had: the system tells that one alone, and outside Linux nothing else.
    """
    # Not getrusage's figure for this process, where there is another: it also counts the parent that started it.
    own = _process_peak_rss_mib("self")
    together = (_maxrss_mib(resource.RUSAGE_SELF) if own is None else own) + sum(_worker_peaks_mib.values())
    return max(together, _maxrss_mib(resource.RUSAGE_CHILDREN))


def environment() -> dict[str, Any]:
    """Commit, Python, packages, processor, cores and graphics card of this run."""
    return {
        "commit": _commit(),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cpu": cpu_name(),
        "cores": os.cpu_count(),
        "gpu": _gpu_name(),
        "packages": dict(sorted((d.metadata["Name"], d.version) for d in distributions())),
    }


def cpu_name() -> str:
    """The processor's model name."""
    cpuinfo = Path("/proc/cpuinfo")
    found = re.search(r"^model name\s*:\s*(.+)$", cpuinfo.read_text(), re.MULTILINE) if cpuinfo.exists() else None
    return found.group(1) if found else platform.processor() or platform.machine()


def _process_peak_rss_mib(process: str) -> float | None:
    """VmHWM of a process in Linux's /proc; None elsewhere, and when the process is gone."""
    try:
        status = Path(f"/proc/{process}/status").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return None
    found = re.search(r"^VmHWM:\s+(\d+) kB", status, re.MULTILINE)
    return int(found.group(1)) * 1024 / MIB if found else None


def _maxrss_mib(who: int) -> float:
    unit_bytes = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(who).ru_maxrss * unit_bytes / MIB


def _commit() -> str | None:
    """The checked-out commit, with `+` when files differ from it; None outside a checkout."""
    try:
        describe = ["git", "-C", str(REPOSITORY_DIR), "describe", "--always", "--abbrev=40", "--dirty=+", "--exclude=*"]
        done = subprocess.run(describe, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        return None
    return done.stdout.strip() or None


def _gpu_name() -> str | None:
    """The first CUDA device, if the stage that ran has loaded torch; this module does not load it.

    None also where a card lets nobody in (busy in exclusive mode): its name is not worth the finished work.
    """
    torch = sys.modules.get("torch")
    try:
        return str(torch.cuda.get_device_name(0)) if torch and torch.cuda.is_available() else None
    except RuntimeError:
        return None
