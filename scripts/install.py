"""Install `requirements.lock` into the virtual environment, with the CPU build of torch or, on request, the CUDA build.

Uses the standard library only: `python -m scripts.install requirements.lock [EXTRA ...]`.

The Linux wheel of torch on PyPI is the CUDA build, several gigabytes with its dependencies. The CPU build has the same
version with the suffix `+cpu`; pip prefers it if a local folder (`PIP_FIND_LINKS`) or an index offers it. Therefore
torch is installed first, with PyTorch's own index if it is reachable, and everything else from PyPI.
"""

import json
import os
import re
import subprocess
import sys
import tomllib
import urllib.request
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from urllib.error import URLError

TORCH_CPU_INDEX = "https://download.pytorch.org/whl/cpu"
PROBE_TIMEOUT_S = 5.0
PROJECT_FILE = Path(__file__).resolve().parents[1] / "pyproject.toml"


def main(arguments: Sequence[str]) -> int:
    """Install a lock file (first argument) and extras of pyproject.toml (further arguments); return the exit status."""
    lock, extras = Path(arguments[0]), list(arguments[1:])
    pin = torch_pin(lock.read_text(encoding="utf-8"))
    use_cuda = "cuda" in extras
    if use_cuda and installed_torch().endswith("+cpu"):
        _pip("uninstall", "--yes", "torch")
    if not installed_torch():
        _pip("install", *torch_pip_arguments(pin, lock, use_cuda))
    _pip("install", "--requirement", str(lock))
    wanted = [package for extra in extras for package in extra_packages(extra)]
    if wanted:
        _pip("install", "--constraint", str(lock), *wanted)
    return 0


def torch_pin(lock_text: str) -> str:
    """Return the line `torch==X.Y.Z` of a lock file."""
    found = re.search(r"^torch==\S+$", lock_text, re.MULTILINE)
    if not found:
        raise SystemExit("error: the lock file has no line torch==VERSION: write it again with `make lock`")
    return found.group(0)


def torch_pip_arguments(pin: str, lock: Path, use_cuda: bool) -> list[str]:
    """Return the arguments of `pip install` for torch; TORCH_INDEX names another index, or is empty for none."""
    index = os.environ.get("TORCH_INDEX")
    if use_cuda:
        return [pin, "--constraint", str(lock), *(["--extra-index-url", index] if index else [])]
    if index is None and not resolves_to_cpu_build(pin):
        index = TORCH_CPU_INDEX if is_index_reachable(TORCH_CPU_INDEX) else None
        if index is None:
            print(f"note: {TORCH_CPU_INDEX} is not reachable: pip installs the build of PyPI, which may be large")
            return [pin, "--constraint", str(lock)]
    return [pin, "--no-deps", *(["--extra-index-url", index] if index else [])]


def resolves_to_cpu_build(pin: str) -> bool:
    """Return True if pip, as it is configured here, would choose a wheel without CUDA."""
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--dry-run", "--no-deps", "--report", "-", pin]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        return False
    chosen = [item["metadata"]["version"] for item in json.loads(done.stdout)["install"]]
    return sys.platform != "linux" or any(name.endswith("+cpu") for name in chosen)


def is_index_reachable(index: str) -> bool:
    """Return True if a package index is reachable."""
    try:
        with urllib.request.urlopen(f"{index}/torch/", timeout=PROBE_TIMEOUT_S):
            return True
    except (URLError, TimeoutError, ConnectionError):
        return False


def installed_torch() -> str:
    """Return the version of the installed torch, empty if there is none."""
    try:
        return version("torch")
    except PackageNotFoundError:
        return ""


def extra_packages(extra: str) -> list[str]:
    """Return the packages of an extra of pyproject.toml."""
    extras = tomllib.loads(PROJECT_FILE.read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    if extra not in extras:
        raise SystemExit(f"error: EXTRA={extra} is unknown: use one of {', '.join(extras)}")
    packages: list[str] = extras[extra]
    return packages


def _pip(*arguments: str) -> None:
    done = subprocess.run([sys.executable, "-m", "pip", *arguments, "--disable-pip-version-check"], check=False)
    if done.returncode != 0:
        raise SystemExit(f"error: pip {arguments[0]} failed, see above: correct it and run the same command again")


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
