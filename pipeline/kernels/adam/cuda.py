"""CUDA kernel of Adam: a thread for each element."""

import math

import numpy as np
from numba import cuda
from torch import Tensor

from pipeline.kernels.common.cuda import CUDA_OPTIONS, launch

_LIMIT, _TINY, _ZERO, _ONE = np.float32(1e18), np.float32(1e-30), np.float32(0), np.float32(1)


@cuda.jit(**CUDA_OPTIONS)
def update_elements(parameter, gradient, first, second, rate, beta1, beta2, scaled_epsilon):
    """Update flat arrays; `rate` and `scaled_epsilon` include the bias corrections."""
    i = cuda.grid(1)
    if i >= parameter.shape[0]:
        return
    g = gradient[i]
    g = g if abs(g) < _LIMIT else _ZERO
    m = beta1 * first[i] + (_ONE - beta1) * g
    v = beta2 * second[i] + (_ONE - beta2) * g * g
    m = m if abs(m) > _TINY else _ZERO
    v = v if v > _TINY else _ZERO
    first[i], second[i], gradient[i] = m, v, _ZERO
    parameter[i] -= rate * m / (math.sqrt(v) + scaled_epsilon)


def update(
    parameter: Tensor,
    gradient: Tensor,
    first: Tensor,
    second: Tensor,
    rate: float,
    beta1: float,
    beta2: float,
    scaled_epsilon: float,
) -> None:
    """Do `pipeline.kernels.adam.cpu.update`, on contiguous tensors of one shape."""
    flat = (tensor.detach().view(-1) for tensor in (parameter, gradient, first, second))
    scalars = (np.float32(value) for value in (rate, beta1, beta2, scaled_epsilon))
    launch(update_elements, parameter.numel(), *flat, *scalars)
