"""Compiled loop of the Broyden search: each thread solves whole points."""

from typing import NamedTuple

import numpy as np
from numba import njit, prange

from pipeline.kernels.common.numba_options import NJIT_OPTIONS
from pipeline.kernels.inverse_skinning.newton_cpu import invert

_ZERO, _ONE = np.float32(0), np.float32(1)


class SearchLimits(NamedTuple):
    """Iterations; residuals (m) at convergence and divergence; distance (m) below which two roots are the same."""

    iterations: int
    converged: float
    diverged: float
    duplicate: float


@njit(**NJIT_OPTIONS)
def _blend(x, frame, lattice, blended, matrix):
    """Fill the skinning matrix (12) at a canonical point; return False outside the grid."""
    origin, cell, row_of_node = lattice
    gx, gy, gz = (x[0] - origin[0]) / cell, (x[1] - origin[1]) / cell, (x[2] - origin[2]) / cell
    i, j, k = int(np.floor(gx)), int(np.floor(gy)), int(np.floor(gz))
    shape = row_of_node.shape
    if not (0 <= i < shape[0] - 1 and 0 <= j < shape[1] - 1 and 0 <= k < shape[2] - 1):
        return False
    u, v, w = gx - np.float32(i), gy - np.float32(j), gz - np.float32(k)
    matrix[:] = _ZERO
    for corner in range(8):
        a, b, c = corner & 1, (corner >> 1) & 1, corner >> 2
        row = row_of_node[i + a, j + b, k + c]
        if row < 0:
            return False
        weight = (u if a == 1 else _ONE - u) * (v if b == 1 else _ONE - v) * (w if c == 1 else _ONE - w)
        for entry in range(12):
            matrix[entry] += weight * blended[row, frame, entry]
    return True


@njit(**NJIT_OPTIONS)
def _residual(matrix, x, target, residual):
    """Fill `residual` (3) with A(x) x - p; return its squared length."""
    squared = _ZERO
    for axis in range(3):
        row = 4 * axis
        value = matrix[row] * x[0] + matrix[row + 1] * x[1] + matrix[row + 2] * x[2] + matrix[row + 3] - target[axis]
        residual[axis] = value
        squared += value * value
    return squared


@njit(**NJIT_OPTIONS)
def _broyden_update(inverse, delta_x, delta_residual):
    """Do Broyden's good update of the inverse Jacobian in place; return False if it is not possible."""
    along, ahead = np.empty(3, np.float32), np.empty(3, np.float32)
    scale = _ZERO
    for axis in range(3):
        along[axis] = delta_x[0] * inverse[0, axis] + delta_x[1] * inverse[1, axis] + delta_x[2] * inverse[2, axis]
        ahead[axis] = (
            inverse[axis, 0] * delta_residual[0]
            + inverse[axis, 1] * delta_residual[1]
            + inverse[axis, 2] * delta_residual[2]
        )
        scale += along[axis] * delta_residual[axis]
    if abs(scale) < np.float32(1e-14):
        return False
    for row in range(3):
        for column in range(3):
            inverse[row, column] += (delta_x[row] - ahead[row]) * along[column] / scale
    return True


@njit(**NJIT_OPTIONS)
def _find_root(target, x, frame, lattice, blended, limits, inverse, matrix):
    """Move `x` to a root of A(x) x = target; return whether it converged. inverse (3, 3), matrix (12): buffers."""
    converged, diverged = np.float32(limits.converged), np.float32(limits.diverged)
    residual, before, delta_x = np.empty(3, np.float32), np.empty(3, np.float32), np.empty(3, np.float32)
    if not _blend(x, frame, lattice, blended, matrix):
        return False
    invertible, (a, b, c, d, e, f, g, h, k) = invert(
        (matrix[0], matrix[1], matrix[2], matrix[4], matrix[5], matrix[6], matrix[8], matrix[9], matrix[10])
    )
    if not invertible:
        return False
    inverse[0, 0], inverse[0, 1], inverse[0, 2] = a, b, c
    inverse[1, 0], inverse[1, 1], inverse[1, 2] = d, e, f
    inverse[2, 0], inverse[2, 1], inverse[2, 2] = g, h, k
    squared = _residual(matrix, x, target, residual)
    for _ in range(limits.iterations):
        if squared < converged * converged:
            return True
        for axis in range(3):
            before[axis] = residual[axis]
            delta_x[axis] = -(
                inverse[axis, 0] * residual[0] + inverse[axis, 1] * residual[1] + inverse[axis, 2] * residual[2]
            )
            x[axis] += delta_x[axis]
        if not _blend(x, frame, lattice, blended, matrix):
            return False
        squared = _residual(matrix, x, target, residual)
        if squared > diverged * diverged:
            return False
        for axis in range(3):
            before[axis] = residual[axis] - before[axis]
        if squared >= converged * converged and not _broyden_update(inverse, delta_x, before):
            return False
    return squared < converged * converged


@njit(parallel=True, **NJIT_OPTIONS)
def find_roots(posed, frame, posed_to_start, lattice, blended, limits, roots, counts):
    """Fill roots (n, c, 3) and their number (n) for each posed point: see `pipeline.kernels.broyden.find_roots`.

    posed_to_start (k, b, 12): inverse matrices of the starting bones. blended (m, k, 12): matrices at the nodes.
    """
    duplicate = np.float32(limits.duplicate)
    for point in prange(posed.shape[0]):
        x, matrix, inverse = np.empty(3, np.float32), np.empty(12, np.float32), np.empty((3, 3), np.float32)
        f, found = frame[point], 0
        for start in range(posed_to_start.shape[1]):
            if found == roots.shape[1]:
                break
            m = posed_to_start[f, start]
            for axis in range(3):
                x[axis] = (
                    m[4 * axis] * posed[point, 0]
                    + m[4 * axis + 1] * posed[point, 1]
                    + m[4 * axis + 2] * posed[point, 2]
                    + m[4 * axis + 3]
                )
            new = _find_root(posed[point], x, f, lattice, blended, limits, inverse, matrix)
            for other in range(found):
                ox, oy, oz = x[0] - roots[point, other, 0], x[1] - roots[point, other, 1], x[2] - roots[point, other, 2]
                new &= ox * ox + oy * oy + oz * oz > duplicate * duplicate
            if new:
                roots[point, found, 0], roots[point, found, 1], roots[point, found, 2] = x[0], x[1], x[2]
                found += 1
        counts[point] = found
