"""The doctor names what is missing and the command that mends it, with the standard library alone."""

import subprocess
import sys
from pathlib import Path

import pytest

from scripts import doctor


def test_a_missing_library_is_noticed() -> None:
    assert not doctor.is_loadable("libno-such-thing.so.9")
    assert doctor.is_loadable("libc.so.6")


def test_a_missing_library_names_its_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "is_loadable", lambda library: library != "libGL.so.1")
    assert doctor.missing_packages() == ["libgl1"]
    (problem,) = doctor.package_problems(["libgl1"])
    assert "apt-get install --no-install-recommends --yes libgl1" in problem


def test_a_missing_venv_module_names_its_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor.importlib.util, "find_spec", lambda name: None)
    assert doctor.VENV_PACKAGE in doctor.missing_packages()


def test_another_python_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    assert doctor.python_problems() == []
    monkeypatch.setattr(doctor.sys, "version_info", (3, 13, 1))
    assert "Python 3.11" in doctor.python_problems()[0]


def test_too_little_space_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "MIN_FREE_DISK_GIB", 1e9)
    monkeypatch.setattr(doctor, "MIN_MEMORY_GIB", 1e9)
    disk, memory = doctor.disk_and_memory_problems(tmp_path)
    assert disk.startswith("disk space")
    assert memory.startswith("memory")


def test_the_doctor_finds_this_machine_ready(capsys: pytest.CaptureFixture[str]) -> None:
    assert doctor.main([]) == 0
    assert "all is there" in capsys.readouterr().out


def test_exit_status_reports_problems(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(doctor, "is_loadable", lambda library: False)
    assert doctor.main([]) == 1
    assert "missing: system packages" in capsys.readouterr().out
    assert doctor.main(["--packages"]) == 0
    assert "libgl1" in capsys.readouterr().out.split()


@pytest.mark.parametrize("module", ["scripts.doctor", "scripts.install"])
def test_it_runs_before_anything_is_installed(repository: Path, module: str) -> None:
    code = f"import {module}, sys; print(*[name for name in sys.modules if name in ('yaml', 'pydantic', 'tqdm')])"
    done = subprocess.run([sys.executable, "-c", code], cwd=repository, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""
