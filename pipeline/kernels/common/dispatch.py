"""One rule decides which twin of a kernel runs: float32 on the CPU takes numba, all else plain torch."""

from torch import Tensor, float32


def runs_on_numba(*tensors: Tensor) -> bool:
    """True if every tensor is float32 on the CPU, so that its memory can be handed to a compiled loop."""
    return all(tensor.dtype == float32 and tensor.device.type == "cpu" for tensor in tensors)
