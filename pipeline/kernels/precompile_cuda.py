"""Compile the CUDA kernels before a stage calls them, where numba-cuda is installed and there is a GPU."""

from pipeline.kernels.common.dispatch import has_numba_cuda
from pipeline.kernels.common.numba_options import CUDA_CACHE_FOLDER

MARKER = "complete"


def is_prepared() -> bool:
    """Return whether `prepare` was done with these sources, or numba-cuda is not installed."""
    return not has_numba_cuda() or (CUDA_CACHE_FOLDER / MARKER).is_file()


def prepare() -> None:
    """Compile the kernels of `SIGNATURES` for the GPU, if there is one; without it none is called."""
    import torch  # as below: `is_prepared` takes milliseconds

    if torch.cuda.is_available():
        from pipeline.kernels.cuda_signatures import SIGNATURES

        for kernel, arguments in SIGNATURES:
            kernel.compile(arguments)
    CUDA_CACHE_FOLDER.mkdir(parents=True, exist_ok=True)
    (CUDA_CACHE_FOLDER / MARKER).touch()
