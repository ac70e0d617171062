"""The check of the machine names what is missing and the command that installs it; standard library only."""

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
    for version in ((3, 11, 7), (3, 12, 1)):
        monkeypatch.setattr(doctor.sys, "version_info", version)
        assert doctor.python_problems() == []
    for version in ((3, 10, 13), (3, 13, 1)):
        monkeypatch.setattr(doctor.sys, "version_info", version)
        assert "Python 3.11 or 3.12" in doctor.python_problems()[0]


def test_the_supported_versions_are_those_of_the_project(repository: Path) -> None:
    text = (repository / "pyproject.toml").read_text(encoding="utf-8")
    (first_major, first), (last_major, last) = doctor.SUPPORTED_PYTHONS[0], doctor.SUPPORTED_PYTHONS[-1]
    assert f'requires-python = ">={first_major}.{first},<{last_major}.{last + 1}"' in text


@pytest.mark.parametrize("platform", ["darwin", "win32"])
def test_other_systems_need_no_debian_packages(monkeypatch: pytest.MonkeyPatch, platform: str) -> None:
    monkeypatch.setattr(doctor.sys, "platform", platform)
    monkeypatch.setattr(doctor, "is_loadable", lambda library: False)
    assert doctor.missing_packages() == []


def test_the_memory_is_not_checked_where_it_is_unknown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(doctor.os, "sysconf")
    monkeypatch.setattr(doctor, "MIN_FREE_DISK_GIB", 0.0)
    monkeypatch.setattr(doctor, "MIN_MEMORY_GIB", 1e9)
    assert doctor.disk_and_memory_problems(tmp_path) == []


def test_too_little_space_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "MIN_FREE_DISK_GIB", 1e9)
    monkeypatch.setattr(doctor, "MIN_MEMORY_GIB", 1e9)
    disk, memory = doctor.disk_and_memory_problems(tmp_path)
    assert disk.startswith("disk space")
    assert memory.startswith("memory")


def test_the_doctor_finds_this_machine_ready(capsys: pytest.CaptureFixture[str]) -> None:
    assert doctor.main([]) == 0
    assert "all requirements are met" in capsys.readouterr().out


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
