"""The wheel: it holds all modules, presets and assets, and works from another folder, also where it is read-only."""

import os
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.core.toy_pipeline import user_environment

PACKAGES = ("pipeline", "stages", "data_tools", "configs")
PROJECT_FILES = ("pyproject.toml", "README.md", "LICENSE")
DATA_FOLDERS = ("pipeline/report/assets", "configs", "data_tools/baselines")


@pytest.fixture(scope="module")
def wheel(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built from a copy: setuptools would add what an earlier build left in the checkout."""
    folder = tmp_path_factory.mktemp("wheel")
    for name in PACKAGES:
        shutil.copytree(repository / name, folder / "source" / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in PROJECT_FILES:
        shutil.copy(repository / name, folder / "source")
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "--no-index"]
    subprocess.run([*command, "--wheel-dir", str(folder), str(folder / "source")], check=True)
    (path,) = folder.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder with the content of the wheel, as `pip install --target` makes it, without permission to write."""
    folder = tmp_path_factory.mktemp("installed")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder)
    for path in [folder, *folder.rglob("*")]:
        path.chmod(0o555 if path.is_dir() else 0o444)
    yield folder
    for path in [folder, *folder.rglob("*")]:
        path.chmod(0o755)


def command(installed: Path, folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run the console command of the wheel in `folder`; its entry point is what pip writes into bin/."""
    entry_point = "import sys; from stages.__main__ import console_main; sys.exit(console_main())"
    environment = user_environment() | {"PYTHONPATH": str(installed), "NUMBA_CACHE_DIR": str(folder / "numba")}
    return subprocess.run(
        [sys.executable, "-P", "-c", entry_point, *arguments],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )


def artifacts(folder: Path) -> dict[Path, int]:
    """Modification times of all files except bytecode, which root writes in spite of the permissions."""
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*") if "__pycache__" not in path.parts}


def test_the_wheel_holds_all_modules_presets_and_assets(wheel: Path, repository: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    files = [path for package in PACKAGES for path in (repository / package).rglob("*.py")]
    files += [path for folder in DATA_FOLDERS for path in (repository / folder).glob("*") if path.is_file()]
    assert {path.relative_to(repository).as_posix() for path in files} <= names
    top_level = {name.split("/")[0] for name in names}
    assert {name for name in top_level if not name.endswith(".dist-info")} == set(PACKAGES)
    assert (
        "instant-human-mesh = stages.__main__:console_main"
        in zipfile.ZipFile(wheel).read(next(name for name in names if name.endswith("entry_points.txt"))).decode()
    )


def test_the_installed_command_finds_its_presets(installed: Path, tmp_path: Path) -> None:
    (tmp_path / "notes.mp4").write_text("not a video")
    done = command(installed, tmp_path, "notes.mp4", "--preset", "instnt")
    assert done.returncode == 2
    assert done.stderr.startswith("error: preset instnt is unknown: use one of default, fine, instant, smoke, ")
    assert command(installed, tmp_path, "--version").stdout.strip()
    assert not (tmp_path / "runs" / "notes").exists()


@pytest.mark.slow
def test_the_installed_command_refuses_a_broken_video(installed: Path, tmp_path: Path) -> None:
    """The first stage is started from the wheel, although the folder holds modules of the same names."""
    for name in ("stages.py", "pipeline.py"):
        (tmp_path / name).write_text("raise ImportError('not the installed module')")
    (tmp_path / "notes.mp4").write_text("not a video")
    done = command(installed, tmp_path, "notes.mp4", "--preset", "instant")
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    assert "notes.mp4" in done.stderr.splitlines()[-1]
    assert not (tmp_path / "runs" / "notes").exists()


@pytest.mark.slow
def test_a_read_only_installation_makes_an_avatar(installed: Path, smoke_run: Path, tmp_path: Path) -> None:
    video = smoke_run.parent / "capture" / "video" / "video.mp4"
    before = artifacts(installed)
    done = command(installed, tmp_path, str(video), "--run", "me", "--preset", "smoke")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "me" / "export" / "avatar.glb").is_file()
    assert command(installed, tmp_path, "--run", "me", "--status").stdout.count("fresh") == 7
    assert command(installed, tmp_path, "mesh", "me").stdout == f"me{os.sep}mesh: cached\n"
    assert artifacts(installed) == before
