"""Imports point down only: import-linter's contracts hold, and each of them is seen failing on a planted import."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGES = ("pipeline", "stages", "data_tools", "tests")
LINTER = Path(sys.executable).with_name("lint-imports")


def lint(folder: Path) -> subprocess.CompletedProcess[str]:
    """Run import-linter on the packages below `folder`."""
    return subprocess.run(
        [str(LINTER), "--no-cache"], cwd=folder, capture_output=True, text=True, check=False, timeout=120
    )


@pytest.fixture
def copied_house(repository: Path, tmp_path: Path) -> Path:
    """A copy of all sources, for planting faults."""
    shutil.copy(repository / "pyproject.toml", tmp_path)
    for package in PACKAGES:
        for source in (repository / package).rglob("*.py"):
            target = tmp_path / source.relative_to(repository)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(source, target)
    return tmp_path


def test_the_contracts_hold(repository: Path) -> None:
    done = lint(repository)
    assert done.returncode == 0, done.stdout


@pytest.mark.parametrize(
    ("importer", "imported", "broken"),
    [
        ("pipeline/kernels/common/hashing.py", "pipeline.geometry.camera", "Imports point down"),
        ("pipeline/geometry/camera.py", "pipeline.core.errors", "Imports point down"),
        ("pipeline/body/body.py", "pipeline.io.npz", "Imports point down"),
        ("pipeline/io/npz.py", "stages.frames", "Imports point down"),
        ("stages/frames.py", "stages.mesh", "A stage never imports a stage"),
        ("pipeline/core/errors.py", "pipeline.kernels.common.hashing", "knows nothing of 3D"),
    ],
)
def test_a_planted_import_is_found(copied_house: Path, importer: str, imported: str, broken: str) -> None:
    with (copied_house / importer).open("a") as file:
        file.write(f"\nimport {imported}\n")
    done = lint(copied_house)
    assert done.returncode != 0
    complaint = next(line for line in done.stdout.splitlines() if line.endswith("BROKEN") and "Contracts" not in line)
    assert broken in " ".join(done.stdout.split()).split(" BROKEN")[0], complaint
