"""Check whether this machine meets the requirements; name what is missing and the command that installs it.

Uses the standard library only, because it runs before anything is installed: `python3 -m scripts.doctor`.
"""

import ctypes
import importlib.util
import os
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

SUPPORTED_PYTHONS = ((3, 11), (3, 12))
MIN_FREE_DISK_GIB = 6.0
MIN_MEMORY_GIB = 3.0
GIB = 1024.0**3

# Shared libraries that the wheels load from a Linux system, without glibc, and their Debian packages. A minimal
# Debian 12 may lack them. Found in /proc/self/maps after importing and using every dependency. The wheels for macOS and
# Windows bring their libraries.
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
    """Print the problems; return 1 if there are any, else 0. With `--packages`, print missing Debian packages only."""
    packages = missing_packages()
    if "--packages" in arguments:
        print(" ".join(packages))
        return 0
    problems = [*python_problems(), *package_problems(packages), *disk_and_memory_problems(Path.cwd())]
    for problem in problems:
        print(f"missing: {problem}")
    if not problems:
        print(f"all requirements are met: Python {sys.version.split()[0]}, system libraries, disk space, memory")
    return 1 if problems else 0


def missing_packages() -> list[str]:
    """Return the Debian packages of the libraries that cannot be loaded, and python3-venv without `ensurepip`."""
    if sys.platform != "linux":
        return []
    missing = [package for library, package in SYSTEM_LIBRARIES.items() if not is_loadable(library)]
    return missing if importlib.util.find_spec("ensurepip") else [*missing, VENV_PACKAGE]


def is_loadable(library: str) -> bool:
    """Return True if the system's loader finds a shared library."""
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def python_problems() -> list[str]:
    """Return the problem with the version of this interpreter, if there is one."""
    if sys.version_info[:2] in SUPPORTED_PYTHONS:
        return []
    versions = [".".join(map(str, version)) for version in SUPPORTED_PYTHONS]
    found = sys.version.split()[0]
    return [f"Python {' or '.join(versions)} (this is {found}): make PYTHON=/path/to/python{versions[-1]}"]


def package_problems(packages: Sequence[str]) -> list[str]:
    """Return the problem of missing Debian packages, with the command that installs them."""
    if not packages:
        return []
    sudo = "" if hasattr(os, "geteuid") and os.geteuid() == 0 else "sudo "
    command = f"{sudo}apt-get install --no-install-recommends --yes {' '.join(packages)}"
    return [f"system packages {', '.join(packages)}: {command}"]


def disk_and_memory_problems(folder: Path) -> list[str]:
    """Return the problems of too little free disk space at `folder` and of too little memory."""
    problems = []
    free_gib = shutil.disk_usage(folder).free / GIB
    if free_gib < MIN_FREE_DISK_GIB and not (folder / ".venv").exists():
        problems.append(
            f"disk space: {free_gib:.1f} GiB are free at {folder}, {MIN_FREE_DISK_GIB:.0f} are needed: free some space"
        )
    memory_gib = total_memory_gib()
    if memory_gib is not None and memory_gib < MIN_MEMORY_GIB:
        problems.append(f"memory: {memory_gib:.1f} GiB, {MIN_MEMORY_GIB:.0f} are needed: close programs or add swap")
    return problems


def total_memory_gib() -> float | None:
    """Return the memory of this machine in GiB; None on Windows, where the standard library does not report it."""
    if not hasattr(os, "sysconf"):
        return None
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / GIB


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
