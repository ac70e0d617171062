"""Every pinned package has a wheel for the other supported Python version and systems; needs a package index."""

import re
import subprocess
import sys
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from scripts.install import is_index_reachable

INDEX = "https://pypi.org/simple"
LINUX = tuple(f"manylinux_2_{minor}_x86_64" for minor in range(35, 16, -1)) + ("manylinux2014_x86_64",)
MACOS = tuple(f"macosx_{major}_0_{kind}" for major in range(14, 10, -1) for kind in ("arm64", "universal2"))
TARGETS = {
    "Linux": ("3.12", LINUX),
    "macOS on ARM": ("3.12", MACOS),
    "Windows": ("3.12", ("win_amd64",)),
}
MISSING: dict[str, set[str]] = {}
"""Packages without a wheel for a target."""


def is_pure_python(pin: str) -> bool:
    """Whether the installed wheel of `NAME==VERSION` is for all systems."""
    try:
        text = distribution(pin.partition("==")[0]).read_text("WHEEL") or ""
    except PackageNotFoundError:
        return False
    return "Root-Is-Purelib: true" in text


def find_missing(pins: list[str], python: str, platforms: tuple[str, ...], folder: str) -> set[str]:
    """Names of the packages for which pip finds no wheel of the pinned version; downloads those that exist."""
    missing = set()
    while pins:
        command = [sys.executable, "-m", "pip", "install", "--dry-run", "--ignore-installed", "--no-deps", "--quiet"]
        command += ["--only-binary=:all:", "--python-version", python, "--implementation", "cp"]
        command += [word for platform in platforms for word in ("--platform", platform)]
        command += ["--target", f"{folder}/target", "--cache-dir", f"{folder}/cache", *pins]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode == 0:
            break
        found = re.search(r"No matching distribution found for (\S+?)==", done.stderr)
        assert found, done.stderr
        missing.add(found.group(1))
        pins = [pin for pin in pins if pin.partition("==")[0] != found.group(1)]
    return missing


@pytest.fixture
def downloads() -> Iterator[str]:
    """Folder for about a gigabyte of downloads, removed after the test; skips without a package index."""
    if not is_index_reachable(INDEX):
        pytest.skip("no package index is reachable")
    with TemporaryDirectory() as folder:
        yield folder


@pytest.mark.slow
@pytest.mark.parametrize("target", TARGETS)
def test_every_compiled_pin_has_a_wheel(downloads: str, repository: Path, target: str) -> None:
    python, platforms = TARGETS[target]
    text = (repository / "requirements.lock").read_text(encoding="utf-8")
    compiled = [pin for pin in re.findall(r"^\S+==\S+$", text, re.MULTILINE) if not is_pure_python(pin)]
    assert "numpy" in {pin.partition("==")[0] for pin in compiled}
    assert find_missing(compiled, python, platforms, downloads) == MISSING.get(target, set())


@pytest.mark.slow
def test_a_version_without_a_wheel_is_noticed(downloads: str) -> None:
    assert find_missing(["numpy==1.26.4", "PyYAML==6.0.3"], "3.13", ("win_amd64",), downloads) == {"numpy"}
