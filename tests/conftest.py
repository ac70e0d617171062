"""Fixtures of all tests, and the check of annotated array shapes."""

import os
import subprocess
import sys
from pathlib import Path

import hypothesis
import pytest
import torch
from filelock import FileLock
from jaxtyping import install_import_hook

from pipeline.core.measure import REPOSITORY_DIR
from pipeline.core.progress import take_warnings
from tests.core.toy_pipeline import Toy, user_environment

# numba reads this when it is imported: its CUDA kernels then run in a simulator where there is no GPU.
if not torch.cuda.is_available():
    os.environ["NUMBA_ENABLE_CUDASIM"] = "1"

# Must run before any of these packages is imported. Every annotated shape and dtype in them is checked at each call.
# The numba kernels are left out, because numba compiles plain functions.
CHECKED_PACKAGES = [
    f"pipeline.{name}"
    for name in ("geometry", "io", "capture", "metrics", "body", "texture", "report", "field", "mesh", "avatar")
]
install_import_hook(CHECKED_PACKAGES, "beartype.beartype")

# The first call of a function may load or compile kernels, so no example has a deadline.
hypothesis.settings.register_profile("untimed", deadline=None)
hypothesis.settings.load_profile("untimed")


@pytest.fixture(autouse=True)
def only_own_warnings() -> None:
    """Clear the warnings of earlier tests: they are collected for the whole process."""
    take_warnings()


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder with real captures, `../shared/data` or the value of IHM_SHARED_DATA; skips if it does not exist."""
    folder = Path(os.environ.get("IHM_SHARED_DATA", REPOSITORY_DIR.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no captures at {folder} (set IHM_SHARED_DATA)")
    return folder


@pytest.fixture(scope="session")
def cuda() -> str:
    """Name of torch's CUDA device; skips if there is none. No other place decides this."""
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    return "cuda"


@pytest.fixture(scope="session")
def repository() -> Path:
    """Root of the checkout."""
    return REPOSITORY_DIR


@pytest.fixture
def toy(tmp_path: Path) -> Toy:
    """Three-stage pipeline on numbers with the real runner, in a folder of its own."""
    return Toy(tmp_path / "toy")


@pytest.fixture(scope="session")
def shared_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Temporary folder that all workers of pytest-xdist share during one run of the tests."""
    base = tmp_path_factory.getbasetemp()
    return base.parent if "PYTEST_XDIST_WORKER" in os.environ else base


@pytest.fixture(scope="session")
def smoke_run(shared_folder: Path) -> Path:
    """Finished run of all stages on a small generated capture with the smoke preset; tests do not change it.

    `capture/` in the same folder holds the video and its ground truth. The first worker that needs the run makes it.
    """
    from data_tools.sample import main as make_sample
    from stages import reconstruct

    folder = shared_folder / "smoke"
    with FileLock(shared_folder / "smoke.lock"):
        if not (folder / "run" / "report" / "manifest.json").is_file():
            make_sample([str(folder / "capture"), "--frames", "24", "--size", "192"])
            reconstruct(folder / "capture" / "video", folder / "run", preset="smoke", isolate=False)
    return folder / "run"


@pytest.fixture(scope="session")
def command_run(smoke_run: Path) -> Path:
    """Finished run of the command on the capture of `smoke_run`, to whose bytes those of other runs are compared.

    In the process of the tests NumPy is imported before the pipeline, so that its BLAS divides products of matrices
    between threads: sums have other last bits there.
    """
    folder, video = smoke_run.parent / "command", smoke_run.parent / "capture" / "video"
    command = [sys.executable, "-m", "stages", "--run", str(folder), "--preset", "smoke", "--video", str(video)]
    with FileLock(smoke_run.parent / "command.lock"):
        if not (folder / "report" / "manifest.json").is_file():
            subprocess.run(command, cwd=REPOSITORY_DIR, env=user_environment(), check=True, capture_output=True)
    return folder
