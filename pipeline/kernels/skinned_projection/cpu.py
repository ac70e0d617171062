"""Compiled loops of the projection of skinned vertices and its gradient: one pass over the vertices each.

The blended matrix of a vertex is computed again in the backward pass; to store it would take longer.
"""

from typing import NamedTuple

import numpy as np
from numba import njit, prange

from pipeline.kernels.common.numba_options import NJIT_OPTIONS
from pipeline.kernels.inverse_skinning.newton_cpu import apply_affine

PARTS = 16


class SkinArrays(NamedTuple):
    """Fields of `SparseWeights`, and the first three rows of the matrix of each joint (j, 12)."""

    row_offsets: np.ndarray
    joint: np.ndarray
    weight: np.ndarray
    matrices: np.ndarray


@njit(**NJIT_OPTIONS)
def _fill_blended(skin, vertex, blended):
    """Fill blended (12) with the weighted sum of the matrices of the joints of a vertex.

    The number of columns is a constant here; as a variable, as in `blend`, the projection takes three times as long.
    """
    blended[:] = np.float32(0)
    for entry in range(skin.row_offsets[vertex], skin.row_offsets[vertex + 1]):
        weight, joint = skin.weight[entry], skin.joint[entry]
        for column in range(12):
            blended[column] += weight * skin.matrices[joint, column]


@njit(parallel=True, **NJIT_OPTIONS)
def project_skinned(vertices, skin, intrinsics_px):
    """Return pixel positions (v, 2) and depths (v) of vertices (v, 3)."""
    count = len(vertices)
    vertices_px, depth_m = np.empty((count, 2), np.float32), np.empty(count, np.float32)
    fx, fy, cx, cy = intrinsics_px
    for part in prange(PARTS):
        m = np.empty(12, np.float32)
        for v in range(part * count // PARTS, (part + 1) * count // PARTS):
            _fill_blended(skin, v, m)
            x, y, z = apply_affine(m, vertices[v, 0], vertices[v, 1], vertices[v, 2])
            vertices_px[v, 0], vertices_px[v, 1], depth_m[v] = fx * x / z + cx, fy * y / z + cy, z
    return vertices_px, depth_m


@njit(parallel=True, **NJIT_OPTIONS)
def project_skinned_backward(vertices, grad_px, grad_depth, skin, intrinsics_px):
    """Return the gradient of the vertices (v, 3) from those of pixel positions (v, 2) and depths (v)."""
    count = len(vertices)
    gradient = np.empty((count, 3), np.float32)
    fx, fy = intrinsics_px[0], intrinsics_px[1]
    for part in prange(PARTS):
        m = np.empty(12, np.float32)
        for v in range(part * count // PARTS, (part + 1) * count // PARTS):
            if grad_px[v, 0] == 0.0 and grad_px[v, 1] == 0.0 and grad_depth[v] == 0.0:
                gradient[v] = np.float32(0)
                continue
            _fill_blended(skin, v, m)
            x, y, z = apply_affine(m, vertices[v, 0], vertices[v, 1], vertices[v, 2])
            gx, gy = fx * grad_px[v, 0] / z, fy * grad_px[v, 1] / z
            gz = grad_depth[v] - (gx * x + gy * y) / z
            for axis in range(3):
                gradient[v, axis] = m[axis] * gx + m[4 + axis] * gy + m[8 + axis] * gz
    return gradient
