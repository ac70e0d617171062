"""What all tests share: checked array shapes, the data folder, the graphics card."""

import os
from pathlib import Path

import pytest
from jaxtyping import install_import_hook

# Before any of these is imported: from here on every annotated shape and dtype in them is checked at each call.
# The numba kernels are left out, because numba compiles the plain functions.
CHECKED_PACKAGES = ["pipeline.geometry", "pipeline.avatar", "pipeline.metrics", "pipeline.io"]
install_import_hook(CHECKED_PACKAGES, "beartype.beartype")

REPOSITORY = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder with real captures: `../shared/data`, or where IHM_SHARED_DATA points; skips where there is none."""
    folder = Path(os.environ.get("IHM_SHARED_DATA", REPOSITORY.parent / "shared" / "data"))
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
    return REPOSITORY
