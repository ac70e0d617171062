"""What all tests share: checked array shapes, the data folder, the graphics card."""

import os
import subprocess
import sys
from pathlib import Path

import hypothesis
import pytest
from jaxtyping import install_import_hook

from pipeline.core.measure import REPOSITORY_DIR
from pipeline.core.progress import take_warnings
from tests.core.toy_pipeline import Toy, user_environment

# Before any of these is imported: from here on every annotated shape and dtype in them is checked at each call.
# The numba kernels are left out, because numba compiles the plain functions.
CHECKED_PACKAGES = [
    f"pipeline.{name}"
    for name in ("geometry", "io", "capture", "metrics", "body", "texture", "report", "field", "mesh", "avatar")
]
install_import_hook(CHECKED_PACKAGES, "beartype.beartype")

# A first call loads what numba has compiled: no test is a matter of time.
hypothesis.settings.register_profile("untimed", deadline=None)
hypothesis.settings.load_profile("untimed")


@pytest.fixture(autouse=True)
def only_own_warnings() -> None:
    """What earlier tests warned of is forgotten: stages gather warnings for the whole process."""
    take_warnings()


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder with real captures: `../shared/data`, or where IHM_SHARED_DATA points; skips where there is none."""
    folder = Path(os.environ.get("IHM_SHARED_DATA", REPOSITORY_DIR.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no captures at {folder} (set IHM_SHARED_DATA)")
    return folder


@pytest.fixture(scope="session")
def cuda() -> str:
    """The name of the graphics card's torch device; skips where there is none. The only place that decides this."""
    import torch

    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    return "cuda"


@pytest.fixture(scope="session")
def repository() -> Path:
    """The root of the checkout."""
    return REPOSITORY_DIR


@pytest.fixture
def toy(tmp_path: Path) -> Toy:
    """A three-stage pipeline on numbers with the real runner, in a folder of its own."""
    return Toy(tmp_path / "toy")


@pytest.fixture(scope="session")
def smoke_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The whole pipeline, by its commands, on a small generated capture with the smoke preset: the finished run folder.

    Beside it lies `capture/`, with the video and its truth.
    """
    folder = tmp_path_factory.mktemp("smoke")
    video = folder / "capture" / "video"
    make_sample = ["data_tools.sample", str(folder / "capture"), "--frames", "24", "--size", "192"]
    run_all = ["stages", "--run", str(folder / "run"), "--preset", "smoke", "--video", str(video)]
    for command in (make_sample, run_all):
        subprocess.run([sys.executable, "-m", *command], cwd=REPOSITORY_DIR, env=user_environment(), check=True)
    return folder / "run"
