"""Compiled loops of the hash grid.

Levels are the outer loop, so that one level's table stays in the cache; in the table's gradient each thread owns whole
levels: no atomics, and the same sums in the same order whatever the number of threads.
The factories return one compiled function for each number of features a level: with that number a constant, the inner
loop becomes one vector instruction. (`cache=True` keys on it.)
"""

from functools import cache

import numpy as np
from numba import njit, prange

from pipeline.kernels.hashing import PRIMES
from pipeline.kernels.options import OPTIONS

BLOCK = 128
_PRIME_Y, _PRIME_Z = np.uint32(PRIMES[0]), np.uint32(PRIMES[1])


@njit(**OPTIONS)
def _corners(points, start, stop, level_plan, rows, weights, parts):
    """Table rows (8, BLOCK), weights (8, BLOCK) and positions in the cell (3, BLOCK) of a block of points."""
    cells_x, cells_y, cells_z, first = level_plan[0], level_plan[1], level_plan[2], level_plan[3]
    mask, dense = np.uint32(level_plan[4] - 1), level_plan[5] == 1
    stride_y, stride_z = np.uint32(cells_x + 1), np.uint32((cells_x + 1) * (cells_y + 1))
    one = np.float32(1)
    for k in range(stop - start):
        x = min(max(points[start + k, 0], np.float32(0)), one) * np.float32(cells_x)
        y = min(max(points[start + k, 1], np.float32(0)), one) * np.float32(cells_y)
        z = min(max(points[start + k, 2], np.float32(0)), one) * np.float32(cells_z)
        i = np.uint32(min(np.int32(x), np.int32(cells_x - 1)))
        j = np.uint32(min(np.int32(y), np.int32(cells_y - 1)))
        m = np.uint32(min(np.int32(z), np.int32(cells_z - 1)))
        u, v, w = x - np.float32(i), y - np.float32(j), z - np.float32(m)
        parts[0, k], parts[1, k], parts[2, k] = u, v, w
        i1, j1, m1 = i + np.uint32(1), j + np.uint32(1), m + np.uint32(1)
        if dense:
            y0, y1, z0, z1 = j * stride_y, j1 * stride_y, m * stride_z, m1 * stride_z
            rows[0, k], rows[1, k] = i + y0 + z0, i1 + y0 + z0
            rows[2, k], rows[3, k] = i + y1 + z0, i1 + y1 + z0
            rows[4, k], rows[5, k] = i + y0 + z1, i1 + y0 + z1
            rows[6, k], rows[7, k] = i + y1 + z1, i1 + y1 + z1
        else:
            y0, y1, z0, z1 = j * _PRIME_Y, j1 * _PRIME_Y, m * _PRIME_Z, m1 * _PRIME_Z
            rows[0, k], rows[1, k] = (i ^ y0 ^ z0) & mask, (i1 ^ y0 ^ z0) & mask
            rows[2, k], rows[3, k] = (i ^ y1 ^ z0) & mask, (i1 ^ y1 ^ z0) & mask
            rows[4, k], rows[5, k] = (i ^ y0 ^ z1) & mask, (i1 ^ y0 ^ z1) & mask
            rows[6, k], rows[7, k] = (i ^ y1 ^ z1) & mask, (i1 ^ y1 ^ z1) & mask
        u0, v0, w0 = one - u, one - v, one - w
        weights[0, k], weights[1, k] = u0 * v0 * w0, u * v0 * w0
        weights[2, k], weights[3, k] = u0 * v * w0, u * v * w0
        weights[4, k], weights[5, k] = u0 * v0 * w, u * v0 * w
        weights[6, k], weights[7, k] = u0 * v * w, u * v * w
    return first


@cache
def forward(features: int):
    """(points (n, 3), table (rows, f), plan (l, 6), encoded (n, l*f)) -> None; fills `encoded`."""

    @njit(**OPTIONS)
    def encode_block(points, table, level_plan, encoded, column, start, stop):
        rows = np.empty((8, BLOCK), np.uint32)
        weights = np.empty((8, BLOCK), np.float32)
        parts = np.empty((3, BLOCK), np.float32)
        first = _corners(points, start, stop, level_plan, rows, weights, parts)
        level = table[first:]
        for k in range(stop - start):
            r0, r1, r2, r3 = rows[0, k], rows[1, k], rows[2, k], rows[3, k]
            r4, r5, r6, r7 = rows[4, k], rows[5, k], rows[6, k], rows[7, k]
            w0, w1, w2, w3 = weights[0, k], weights[1, k], weights[2, k], weights[3, k]
            w4, w5, w6, w7 = weights[4, k], weights[5, k], weights[6, k], weights[7, k]
            for f in range(features):
                encoded[start + k, column + f] = (
                    (w0 * level[r0, f] + w1 * level[r1, f]) + (w2 * level[r2, f] + w3 * level[r3, f])
                ) + ((w4 * level[r4, f] + w5 * level[r5, f]) + (w6 * level[r6, f] + w7 * level[r7, f]))

    @njit(parallel=True, **OPTIONS)
    def encode(points, table, plan, encoded):
        count = points.shape[0]
        for level in range(plan.shape[0]):
            for block in prange((count + BLOCK - 1) // BLOCK):
                start = block * BLOCK
                encode_block(points, table, plan[level], encoded, level * features, start, min(start + BLOCK, count))

    return encode


@njit(**OPTIONS)
def _level_of_turn(turn, levels):
    """0, 2, 4, ... and then 1, 3, 5, ...: two threads that take half of the turns each get coarse and fine levels."""
    even = (levels + 1) // 2
    return 2 * turn if turn < even else 2 * (turn - even) + 1


@cache
def backward_table(features: int):
    """(points (n, 3), plan (l, 6), gradient (n, l*f), table_gradient (rows, f)) -> None; adds to `table_gradient`."""

    @njit(**OPTIONS)
    def scatter_block(points, level_plan, gradient, column, table_gradient, start, stop, rows, weights, parts):
        first = _corners(points, start, stop, level_plan, rows, weights, parts)
        level = table_gradient[first:]
        for k in range(stop - start):
            for corner in range(8):
                row, weight = rows[corner, k], weights[corner, k]
                for f in range(features):
                    level[row, f] += weight * gradient[start + k, column + f]

    @njit(parallel=True, **OPTIONS)
    def scatter(points, plan, gradient, table_gradient):
        count = points.shape[0]
        levels = plan.shape[0]
        for turn in prange(levels):
            level = _level_of_turn(turn, levels)
            rows = np.empty((8, BLOCK), np.uint32)
            weights = np.empty((8, BLOCK), np.float32)
            parts = np.empty((3, BLOCK), np.float32)
            for block in range((count + BLOCK - 1) // BLOCK):
                start = block * BLOCK
                stop = min(start + BLOCK, count)
                scatter_block(
                    points, plan[level], gradient, level * features, table_gradient, start, stop, rows, weights, parts
                )

    return scatter


@cache
def backward_points(features: int):
    """(points (n, 3), table (rows, f), plan, gradient (n, l*f), points_gradient (n, 3)) -> None; adds to the last."""

    @njit(**OPTIONS)
    def gather_block(points, table, level_plan, gradient, column, points_gradient, start, stop):
        rows = np.empty((8, BLOCK), np.uint32)
        weights = np.empty((8, BLOCK), np.float32)
        parts = np.empty((3, BLOCK), np.float32)
        first = _corners(points, start, stop, level_plan, rows, weights, parts)
        level = table[first:]
        dots = np.empty(8, np.float32)
        for k in range(stop - start):
            for corner in range(8):
                row, total = rows[corner, k], np.float32(0)
                for f in range(features):
                    total += level[row, f] * gradient[start + k, column + f]
                dots[corner] = total
            u, v, w = parts[0, k], parts[1, k], parts[2, k]
            u0, v0, w0 = np.float32(1) - u, np.float32(1) - v, np.float32(1) - w
            along_x = (
                v0 * w0 * (dots[1] - dots[0])
                + v * w0 * (dots[3] - dots[2])
                + v0 * w * (dots[5] - dots[4])
                + v * w * (dots[7] - dots[6])
            )
            along_y = (
                u0 * w0 * (dots[2] - dots[0])
                + u * w0 * (dots[3] - dots[1])
                + u0 * w * (dots[6] - dots[4])
                + u * w * (dots[7] - dots[5])
            )
            along_z = (
                u0 * v0 * (dots[4] - dots[0])
                + u * v0 * (dots[5] - dots[1])
                + u0 * v * (dots[6] - dots[2])
                + u * v * (dots[7] - dots[3])
            )
            points_gradient[start + k, 0] += along_x * np.float32(level_plan[0])
            points_gradient[start + k, 1] += along_y * np.float32(level_plan[1])
            points_gradient[start + k, 2] += along_z * np.float32(level_plan[2])

    @njit(parallel=True, **OPTIONS)
    def gather(points, table, plan, gradient, points_gradient):
        count = points.shape[0]
        for level in range(plan.shape[0]):
            for block in prange((count + BLOCK - 1) // BLOCK):
                start = block * BLOCK
                stop = min(start + BLOCK, count)
                gather_block(points, table, plan[level], gradient, level * features, points_gradient, start, stop)

    return gather
