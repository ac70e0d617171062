"""Choice of the implementation of a kernel: numba for float32 on the CPU, plain torch for everything else."""

from torch import Tensor, float32


def runs_on_numba(*tensors: Tensor) -> bool:
    """Return True if every tensor is float32 on the CPU, so that a compiled loop can use its memory."""
    return all(tensor.dtype == float32 and tensor.device.type == "cpu" for tensor in tensors)
