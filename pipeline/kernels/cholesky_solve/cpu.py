"""Compiled loops of the solution by factors: forward and backward substitution, three right-hand sides together.

Both read the columns of L in the order of memory; the unknowns fit in the cache.
"""

import numpy as np
from numba import njit

from pipeline.kernels.common.numba_options import NJIT_OPTIONS


@njit(**NJIT_OPTIONS)
def cholesky_solve(column_offsets, row, value, inverse_diagonal, position, right_side):
    """Return x (n, 3) of L D Lᵀ P x = P right_side."""
    count = len(position)
    ordered = np.empty((count, 3), np.float32)
    for unknown in range(count):
        for axis in range(3):
            ordered[position[unknown], axis] = right_side[unknown, axis]
    for column in range(count):
        x, y, z = ordered[column, 0], ordered[column, 1], ordered[column, 2]
        for entry in range(column_offsets[column], column_offsets[column + 1]):
            factor, target = value[entry], row[entry]
            ordered[target, 0] -= factor * x
            ordered[target, 1] -= factor * y
            ordered[target, 2] -= factor * z
    for column in range(count - 1, -1, -1):
        scale = inverse_diagonal[column]
        x, y, z = scale * ordered[column, 0], scale * ordered[column, 1], scale * ordered[column, 2]
        for entry in range(column_offsets[column], column_offsets[column + 1]):
            factor, source = value[entry], row[entry]
            x -= factor * ordered[source, 0]
            y -= factor * ordered[source, 1]
            z -= factor * ordered[source, 2]
        ordered[column, 0], ordered[column, 1], ordered[column, 2] = x, y, z
    solution = np.empty((count, 3), np.float32)
    for unknown in range(count):
        for axis in range(3):
            solution[unknown, axis] = ordered[position[unknown], axis]
    return solution
