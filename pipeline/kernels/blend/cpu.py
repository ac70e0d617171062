"""Compiled loops of blending by sparse weights: the entries of node i are row_offsets[i] : row_offsets[i + 1].

In the backward pass the nodes are divided into a fixed number of parts, whose sums are added in order, so that the
result does not depend on the number of threads.
"""

import numpy as np
from numba import njit, prange

from pipeline.kernels.common.numba_options import NJIT_OPTIONS

PARTS = 16


@njit(**NJIT_OPTIONS)
def _add_scaled(scale, values, total):
    """Add scale * values to total. A function of its own, so that LLVM knows that the slices do not overlap."""
    for column in range(values.shape[0]):
        total[column] += scale * values[column]


@njit(parallel=True, **NJIT_OPTIONS)
def blend(row_offsets, joint, weight, values, blended):
    """Fill blended (m, c) from values (j, c)."""
    nodes = blended.shape[0]
    for part in prange(PARTS):
        for node in range(part * nodes // PARTS, (part + 1) * nodes // PARTS):
            blended[node] = np.float32(0)
            for entry in range(row_offsets[node], row_offsets[node + 1]):
                _add_scaled(weight[entry], values[joint[entry]], blended[node])


@njit(parallel=True, **NJIT_OPTIONS)
def blend_backward(row_offsets, joint, weight, joints, grad_blended):
    """Return the contribution of each part of the nodes to dL/dvalues (PARTS, j, c), from grad_blended (m, c)."""
    nodes, columns = grad_blended.shape
    sums = np.zeros((PARTS, joints, columns), np.float32)
    for part in prange(PARTS):
        for node in range(part * nodes // PARTS, (part + 1) * nodes // PARTS):
            for entry in range(row_offsets[node], row_offsets[node + 1]):
                _add_scaled(weight[entry], grad_blended[node], sums[part, joint[entry]])
    return sums
