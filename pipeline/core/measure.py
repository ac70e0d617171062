"""What a run cost and where it ran: peak memory, processor, packages, commit. Recorded, never used for freshness."""

import os
import platform
import re
import resource
import subprocess
import sys
from importlib.metadata import distributions
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).resolve().parents[2]
MIB = 1024.0 * 1024.0


def peak_rss_mib() -> float:
    """Highest resident memory of this process so far, in MiB, or of its largest finished child if that is more.

    Linux: VmHWM of /proc, because getrusage's figure also counts the parent that started this process.
    """
    children = _maxrss_mib(resource.RUSAGE_CHILDREN)
    status = Path("/proc/self/status")
    if status.exists():
        found = re.search(r"^VmHWM:\s+(\d+) kB", status.read_text(), re.MULTILINE)
        if found:
            return max(int(found.group(1)) * 1024 / MIB, children)
    return max(_maxrss_mib(resource.RUSAGE_SELF), children)


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


def _maxrss_mib(who: int) -> float:
    unit_bytes = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(who).ru_maxrss * unit_bytes / MIB


def _commit() -> str | None:
    """The checked-out commit, with `+` when files differ from it; None outside a checkout."""
    try:
        describe = ["git", "-C", str(REPOSITORY), "describe", "--always", "--abbrev=40", "--dirty=+", "--exclude=*"]
        done = subprocess.run(describe, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        return None
    return done.stdout.strip() or None


def _gpu_name() -> str | None:
    """The first CUDA device, if the stage that ran has loaded torch; this module does not load it."""
    torch = sys.modules.get("torch")
    return str(torch.cuda.get_device_name(0)) if torch and torch.cuda.is_available() else None
