"""Choice of the implementation of a kernel: numba for float32 on the CPU or a CUDA GPU, plain torch for the rest."""

from functools import cache
from importlib.util import find_spec

from torch import Tensor, float32


def runs_on_numba(*tensors: Tensor) -> bool:
    """Return True if every tensor is float32 on the CPU, so that a compiled loop can use its memory."""
    return all(tensor.dtype == float32 and tensor.device.type == "cpu" for tensor in tensors)


def runs_on_cuda(*tensors: Tensor) -> bool:
    """Return True if every tensor is float32 on a CUDA GPU, and numba can compile for it."""
    return all(tensor.dtype == float32 and tensor.device.type == "cuda" for tensor in tensors) and has_numba_cuda()


@cache
def has_numba_cuda() -> bool:
    """Return whether the package numba-cuda is installed; without it a GPU runs the plain-torch references."""
    return find_spec("numba_cuda") is not None
