"""Fill the virtual environment from `requirements.lock`: the CPU build of torch, or the CUDA one on request.

Runs on the bare interpreter (standard library only): `python -m scripts.install requirements.lock [EXTRA ...]`.

PyPI's Linux wheel of torch is the CUDA build and pulls in gigabytes. The small CPU build has the same version with the
suffix `+cpu`, which pip prefers wherever it finds it: in a local folder (`PIP_FIND_LINKS`) or on PyTorch's own index.
So torch goes first, with that index added when it answers, and everything else follows from PyPI.
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
    """Install the lock file named first, then the extras named after it; return pip's exit status."""
    lock, extras = Path(arguments[0]), list(arguments[1:])
    pin = torch_pin(lock.read_text(encoding="utf-8"))
    use_cuda = "cuda" in extras
    if use_cuda and installed_torch().endswith("+cpu"):
        _pip("uninstall", "--yes", "torch")
    if not installed_torch():
        _pip("install", *torch_pip_arguments(pin, lock, use_cuda))
    _pip("install", "--requirement", str(lock))
    wanted = [package for extra in extras if extra != "cuda" for package in extra_packages(extra)]
    if wanted:
        _pip("install", "--constraint", str(lock), *wanted)
    return 0


def torch_pin(lock_text: str) -> str:
    """The `torch==X.Y.Z` line of a lock file."""
    found = re.search(r"^torch==\S+$", lock_text, re.MULTILINE)
    if not found:
        raise SystemExit("error: the lock file has no torch==... line: write it anew with `make lock`")
    return found.group(0)


def torch_pip_arguments(pin: str, lock: Path, use_cuda: bool) -> list[str]:
    """What pip is asked for torch; TORCH_INDEX names another index to add, or is empty for none."""
    index = os.environ.get("TORCH_INDEX")
    if use_cuda:
        return [pin, "--constraint", str(lock), *(["--extra-index-url", index] if index else [])]
    if index is None and not resolves_to_cpu_build(pin):
        index = TORCH_CPU_INDEX if is_index_reachable(TORCH_CPU_INDEX) else None
        if index is None:
            print(f"note: {TORCH_CPU_INDEX} does not answer: pip takes the build that PyPI has, which may be large")
            return [pin, "--constraint", str(lock)]
    return [pin, "--no-deps", *(["--extra-index-url", index] if index else [])]


def resolves_to_cpu_build(pin: str) -> bool:
    """True when pip, as it is configured here, would already choose a wheel without CUDA."""
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--dry-run", "--no-deps", "--report", "-", pin]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        return False
    chosen = [item["metadata"]["version"] for item in json.loads(done.stdout)["install"]]
    return sys.platform != "linux" or any(name.endswith("+cpu") for name in chosen)


def is_index_reachable(index: str) -> bool:
    """True when a package index can be reached."""
    try:
        with urllib.request.urlopen(f"{index}/torch/", timeout=PROBE_TIMEOUT_S):
            return True
    except (URLError, TimeoutError, ConnectionError):
        return False


def installed_torch() -> str:
    """Version of the installed torch, empty when there is none."""
    try:
        return version("torch")
    except PackageNotFoundError:
        return ""


def extra_packages(extra: str) -> list[str]:
    """The packages that pyproject.toml lists under an extra."""
    extras = tomllib.loads(PROJECT_FILE.read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    if extra not in extras:
        raise SystemExit(f"error: EXTRA={extra} is not known: use one of {', '.join(extras)}")
    packages: list[str] = extras[extra]
    return packages


def _pip(*arguments: str) -> None:
    done = subprocess.run([sys.executable, "-m", "pip", *arguments, "--disable-pip-version-check"], check=False)
    if done.returncode != 0:
        raise SystemExit(f"error: pip {arguments[0]} failed, see above: mend it and run the same command again")


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
