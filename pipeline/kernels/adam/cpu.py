"""Compiled loop of Adam. Slices are passed to a function of their own, so that LLVM knows that they do not overlap."""

import numpy as np
from numba import njit, prange

from pipeline.kernels.common.numba_options import NJIT_OPTIONS

CHUNK = 1 << 15


@njit(**NJIT_OPTIONS)
def _update_slice(parameter, gradient, first, second, rate, beta1, beta2, scaled_epsilon):
    limit, tiny, zero = np.float32(1e18), np.float32(1e-30), np.float32(0)
    rest1, rest2 = np.float32(1) - beta1, np.float32(1) - beta2
    for i in range(parameter.shape[0]):
        g = gradient[i]
        g = g if abs(g) < limit else zero
        m = beta1 * first[i] + rest1 * g
        v = beta2 * second[i] + rest2 * g * g
        m = m if abs(m) > tiny else zero
        v = v if v > tiny else zero
        first[i] = m
        second[i] = v
        gradient[i] = zero
        parameter[i] -= rate * m / (np.sqrt(v) + scaled_epsilon)


@njit(parallel=True, **NJIT_OPTIONS)
def _update(parameter, gradient, first, second, rate, beta1, beta2, scaled_epsilon):
    count = parameter.shape[0]
    for chunk in prange((count + CHUNK - 1) // CHUNK):
        a = chunk * CHUNK
        b = min(a + CHUNK, count)
        _update_slice(parameter[a:b], gradient[a:b], first[a:b], second[a:b], rate, beta1, beta2, scaled_epsilon)


def update(parameter, gradient, first, second, rate, beta1, beta2, scaled_epsilon):
    """Do one update of flat float32 arrays; `rate` and `scaled_epsilon` include the bias corrections."""
    scalars = (np.float32(value) for value in (rate, beta1, beta2, scaled_epsilon))
    _update(parameter, gradient, first, second, *scalars)
