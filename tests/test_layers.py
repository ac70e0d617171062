"""Import rules: the contracts of import-linter hold, and each of them finds a planted import."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGES = ("pipeline", "stages", "data_tools", "tests")
LINTER = Path(sys.executable).with_name("lint-imports")

LAYERS = "Imports point down"
INDEPENDENT_STAGES = "A stage never imports a stage"
CORE = "The runner does not depend on 3D"

PLANTED_IMPORTS = [
    ("pipeline/kernels/common/hashing.py", "pipeline.geometry.camera", LAYERS),
    ("pipeline/geometry/camera.py", "pipeline.capture.video", LAYERS),
    ("pipeline/body/body.py", "pipeline.field.occupancy", LAYERS),
    ("pipeline/io/npz.py", "stages.frames", LAYERS),
    ("stages/frames.py", "stages.mesh", INDEPENDENT_STAGES),
    ("pipeline/core/errors.py", "pipeline.kernels.common.hashing", CORE),
]


def lint(folder: Path) -> subprocess.CompletedProcess[str]:
    """Run import-linter on the packages below `folder`."""
    return subprocess.run(
        [str(LINTER), "--no-cache"], cwd=folder, capture_output=True, text=True, check=False, timeout=120
    )


@pytest.fixture(scope="module")
def source_copy(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of all sources in which imports can be planted."""
    folder = tmp_path_factory.mktemp("sources")
    shutil.copy(repository / "pyproject.toml", folder)
    for package in PACKAGES:
        for source in (repository / package).rglob("*.py"):
            target = folder / source.relative_to(repository)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(source, target)
    return folder


def test_the_contracts_hold(repository: Path) -> None:
    done = lint(repository)
    assert done.returncode == 0, done.stdout


@pytest.mark.parametrize(("importer", "imported", "contract"), PLANTED_IMPORTS)
def test_a_planted_import_is_found(source_copy: Path, importer: str, imported: str, contract: str) -> None:
    path = source_copy / importer
    text = path.read_text(encoding="utf-8")
    path.write_text(f"{text}\nimport {imported}\n", encoding="utf-8")
    try:
        done = lint(source_copy)
    finally:
        path.write_text(text, encoding="utf-8")
    assert done.returncode != 0
    verdict = re.search(rf"{contract}.*?(KEPT|BROKEN)", " ".join(done.stdout.split()))
    assert verdict, done.stdout
    assert verdict.group(1) == "BROKEN", done.stdout
