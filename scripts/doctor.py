"""Is this machine ready? Names what is missing and the command that mends it.

Runs on the bare interpreter (standard library only), before anything is installed: `python3 -m scripts.doctor`.
"""

import ctypes
import importlib.util
import os
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

REQUIRED_PYTHON = (3, 11)
MIN_FREE_DISK_GIB = 6.0
MIN_MEMORY_GIB = 3.0
GIB = 1024.0**3

# What the wheels load from the system and a bare Debian 12 may lack, beside glibc: the shared library, then its Debian
# package. Found by reading /proc/self/maps after importing and using every dependency.
SYSTEM_LIBRARIES = {
    "libstdc++.so.6": "libstdc++6",
    "libgcc_s.so.1": "libgcc-s1",
    "libz.so.1": "zlib1g",
    "libgomp.so.1": "libgomp1",
    "libGL.so.1": "libgl1",
    "libOpenGL.so.0": "libopengl0",
    "libX11.so.6": "libx11-6",
    "libxcb.so.1": "libxcb1",
    "libgthread-2.0.so.0": "libglib2.0-0",
    "libfribidi.so.0": "libfribidi0",
    "libgmp.so.10": "libgmp10",
    "libp11-kit.so.0": "libp11-kit0",
    "libgpg-error.so.0": "libgpg-error0",
    "libcom_err.so.2": "libcom-err2",
}
VENV_PACKAGE = "python3-venv"


def main(arguments: Sequence[str]) -> int:
    """Print the findings; return 0 when all is there, else 1. With `--packages`: only the missing Debian packages."""
    packages = missing_packages()
    if "--packages" in arguments:
        print(" ".join(packages))
        return 0
    problems = [*python_problems(), *package_problems(packages), *disk_and_memory_problems(Path.cwd())]
    for problem in problems:
        print(f"missing: {problem}")
    if not problems:
        print(f"all is there: Python {sys.version.split()[0]}, {len(SYSTEM_LIBRARIES)} system libraries, disk, memory")
    return 1 if problems else 0


def missing_packages() -> list[str]:
    """Debian packages whose shared library cannot be loaded, and python3-venv when it is not there."""
    missing = [package for library, package in SYSTEM_LIBRARIES.items() if not is_loadable(library)]
    return missing if importlib.util.find_spec("ensurepip") else [*missing, VENV_PACKAGE]


def is_loadable(library: str) -> bool:
    """True when the system's loader finds a shared library."""
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def python_problems() -> list[str]:
    """The interpreter's version, if it is not the one that the dependencies are pinned for."""
    if sys.version_info[:2] == REQUIRED_PYTHON:
        return []
    wanted = ".".join(map(str, REQUIRED_PYTHON))
    return [f"Python {wanted} (this is {sys.version.split()[0]}): make PYTHON=/path/to/python{wanted}"]


def package_problems(packages: Sequence[str]) -> list[str]:
    """The missing Debian packages with the command that installs them."""
    if not packages:
        return []
    sudo = "" if os.geteuid() == 0 else "sudo "
    command = f"{sudo}apt-get install --no-install-recommends --yes {' '.join(packages)}"
    return [f"system packages {', '.join(packages)}: {command}"]


def disk_and_memory_problems(folder: Path) -> list[str]:
    """Too little free disk under `folder`, or too little memory."""
    problems = []
    free_gib = shutil.disk_usage(folder).free / GIB
    if free_gib < MIN_FREE_DISK_GIB and not (folder / ".venv").exists():
        problems.append(f"disk space: {free_gib:.1f} GiB are free at {folder}, {MIN_FREE_DISK_GIB:.0f} are needed")
    memory_gib = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / GIB
    if memory_gib < MIN_MEMORY_GIB:
        problems.append(f"memory: {memory_gib:.1f} GiB, {MIN_MEMORY_GIB:.0f} are needed: close programs or add swap")
    return problems


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
