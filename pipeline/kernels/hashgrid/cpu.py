"""Compiled loops of the hash grid.

Levels are the outer loop, so that the table of one level stays in the cache. In the gradient of the table each thread
writes whole levels: no atomics, and the same sums in the same order for any number of threads.

The length of the tuple `lanes` is the number of features of a level. A tuple's length is part of its type, hence a
constant in the compiled code, and the inner loop becomes one vector instruction. (A closure over the number would do
the same, but numba never finds a closure that calls another one in its cache.)
"""

from typing import NamedTuple

import numpy as np
from numba import njit, prange

from pipeline.kernels.common.hashing import PRIMES
from pipeline.kernels.common.numba_options import NJIT_OPTIONS

BLOCK = 128
_PRIME_Y, _PRIME_Z = np.uint32(PRIMES[0]), np.uint32(PRIMES[1])


class HashTable(NamedTuple):
    """Rows of all levels (rows, f), or their gradient, and `GridLayout.level_params` (l, 6)."""

    values: np.ndarray
    level_params: np.ndarray


class CornerBuffers(NamedTuple):
    """Buffers for a block of points: table rows (8, BLOCK), weights (8, BLOCK), positions in the cell (3, BLOCK)."""

    rows: np.ndarray
    weights: np.ndarray
    fractions: np.ndarray


@njit(**NJIT_OPTIONS)
def _fill_corners(points, start, stop, params, buffers):
    """Fill the buffers for the points start..stop of one level; return the first row of the level."""
    rows, weights, fractions = buffers
    cells_x, cells_y, cells_z, first = params[0], params[1], params[2], params[3]
    mask, dense = np.uint32(params[4] - 1), params[5] == 1
    stride_y, stride_z = np.uint32(cells_x + 1), np.uint32((cells_x + 1) * (cells_y + 1))
    zero, one = np.float32(0), np.float32(1)
    for k in range(stop - start):
        # `max` returns its second argument only if that is larger, which NaN is not: NaN becomes zero.
        x = min(max(zero, points[start + k, 0]), one) * np.float32(cells_x)
        y = min(max(zero, points[start + k, 1]), one) * np.float32(cells_y)
        z = min(max(zero, points[start + k, 2]), one) * np.float32(cells_z)
        i = np.uint32(min(np.int32(x), np.int32(cells_x - 1)))
        j = np.uint32(min(np.int32(y), np.int32(cells_y - 1)))
        m = np.uint32(min(np.int32(z), np.int32(cells_z - 1)))
        u, v, w = x - np.float32(i), y - np.float32(j), z - np.float32(m)
        fractions[0, k], fractions[1, k], fractions[2, k] = u, v, w
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


@njit(**NJIT_OPTIONS)
def encode_block(points, table, lanes, level, encoded, start, stop):
    """Fill the features of one level of the points start..stop, at most BLOCK."""
    column = level * len(lanes)
    rows = np.empty((8, BLOCK), np.uint32)
    weights = np.empty((8, BLOCK), np.float32)
    buffers = CornerBuffers(rows, weights, np.empty((3, BLOCK), np.float32))
    first = _fill_corners(points, start, stop, table.level_params[level], buffers)
    values = table.values[first:]
    for k in range(stop - start):
        r0, r1, r2, r3 = rows[0, k], rows[1, k], rows[2, k], rows[3, k]
        r4, r5, r6, r7 = rows[4, k], rows[5, k], rows[6, k], rows[7, k]
        w0, w1, w2, w3 = weights[0, k], weights[1, k], weights[2, k], weights[3, k]
        w4, w5, w6, w7 = weights[4, k], weights[5, k], weights[6, k], weights[7, k]
        for f in range(len(lanes)):
            encoded[start + k, column + f] = (
                (w0 * values[r0, f] + w1 * values[r1, f]) + (w2 * values[r2, f] + w3 * values[r3, f])
            ) + ((w4 * values[r4, f] + w5 * values[r5, f]) + (w6 * values[r6, f] + w7 * values[r7, f]))


@njit(parallel=True, **NJIT_OPTIONS)
def encode(points, table, lanes, encoded):
    """Fill `encoded` (n, l*f) at points (n, 3) of the unit box."""
    count = points.shape[0]
    for level in range(table.level_params.shape[0]):
        for block in prange((count + BLOCK - 1) // BLOCK):
            start = block * BLOCK
            encode_block(points, table, lanes, level, encoded, start, min(start + BLOCK, count))


@njit(**NJIT_OPTIONS)
def find_nonzero_rows(values):
    """Return the indices of the rows of `values` (n, c) that are not all zero."""
    rows = np.empty(values.shape[0], np.int64)
    count = 0
    for row in range(values.shape[0]):
        for column in range(values.shape[1]):
            if values[row, column] != np.float32(0):
                rows[count] = row
                count += 1
                break
    return rows[:count]


@njit(**NJIT_OPTIONS)
def _interleaved_level(index, levels):
    """Return 0, 2, 4, ..., then 1, 3, 5, ...: each of two threads then gets coarse and fine levels."""
    even = (levels + 1) // 2
    return 2 * index if index < even else 2 * (index - even) + 1


@njit(**NJIT_OPTIONS)
def _scatter_gradient_block(points, gradient, grad_table, lanes, level, start, stop, buffers):
    rows, weights, _ = buffers
    column = level * len(lanes)
    first = _fill_corners(points, start, stop, grad_table.level_params[level], buffers)
    values = grad_table.values[first:]
    for k in range(stop - start):
        for corner in range(8):
            row, weight = rows[corner, k], weights[corner, k]
            for f in range(len(lanes)):
                values[row, f] += weight * gradient[start + k, column + f]


@njit(parallel=True, **NJIT_OPTIONS)
def add_table_gradient(points, gradient, grad_table, lanes):
    """Add the gradient of the table to `grad_table` (a `HashTable`), from dL/dfeatures = gradient (n, l*f)."""
    count = points.shape[0]
    levels = grad_table.level_params.shape[0]
    for index in prange(levels):
        level = _interleaved_level(index, levels)
        rows = np.empty((8, BLOCK), np.uint32)
        weights = np.empty((8, BLOCK), np.float32)
        buffers = CornerBuffers(rows, weights, np.empty((3, BLOCK), np.float32))
        for block in range((count + BLOCK - 1) // BLOCK):
            start = block * BLOCK
            stop = min(start + BLOCK, count)
            _scatter_gradient_block(points, gradient, grad_table, lanes, level, start, stop, buffers)


@njit(**NJIT_OPTIONS)
def point_gradient_block(points, table, lanes, level, gradient, grad_points, start, stop):
    """Add the contribution of one level to dL/dpoints of the points start..stop, at most BLOCK."""
    level_params = table.level_params
    column = level * len(lanes)
    rows, fractions = np.empty((8, BLOCK), np.uint32), np.empty((3, BLOCK), np.float32)
    buffers = CornerBuffers(rows, np.empty((8, BLOCK), np.float32), fractions)
    first = _fill_corners(points, start, stop, level_params[level], buffers)
    values = table.values[first:]
    cells_x, cells_y, cells_z = (
        np.float32(level_params[level, 0]),
        np.float32(level_params[level, 1]),
        np.float32(level_params[level, 2]),
    )
    # One element for each feature, so that the loops over features have no sum across elements.
    slopes = np.empty((3, len(lanes)), np.float32)
    for k in range(stop - start):
        r0, r1, r2, r3 = rows[0, k], rows[1, k], rows[2, k], rows[3, k]
        r4, r5, r6, r7 = rows[4, k], rows[5, k], rows[6, k], rows[7, k]
        u, v, w = fractions[0, k], fractions[1, k], fractions[2, k]
        for f in range(len(lanes)):
            d0, d1 = values[r1, f] - values[r0, f], values[r3, f] - values[r2, f]
            d2, d3 = values[r5, f] - values[r4, f], values[r7, f] - values[r6, f]
            a0, a1 = values[r0, f] + u * d0, values[r2, f] + u * d1
            a2, a3 = values[r4, f] + u * d2, values[r6, f] + u * d3
            b0, b1 = a1 - a0, a3 - a2
            e0, e1 = d0 + v * (d1 - d0), d2 + v * (d3 - d2)
            g = gradient[start + k, column + f]
            slopes[0, f] = g * (e0 + w * (e1 - e0))
            slopes[1, f] = g * (b0 + w * (b1 - b0))
            slopes[2, f] = g * ((a2 + v * b1) - (a0 + v * b0))
        along_x = along_y = along_z = np.float32(0)
        for f in range(len(lanes)):
            along_x, along_y, along_z = along_x + slopes[0, f], along_y + slopes[1, f], along_z + slopes[2, f]
        grad_points[start + k, 0] += along_x * cells_x
        grad_points[start + k, 1] += along_y * cells_y
        grad_points[start + k, 2] += along_z * cells_z


@njit(parallel=True, **NJIT_OPTIONS)
def add_points_gradient(points, table, lanes, gradient, grad_points):
    """Add dL/dpoints to `grad_points` (n, 3), from dL/dfeatures = gradient (n, l*f)."""
    count = points.shape[0]
    for level in range(table.level_params.shape[0]):
        for block in prange((count + BLOCK - 1) // BLOCK):
            start = block * BLOCK
            stop = min(start + BLOCK, count)
            point_gradient_block(points, table, lanes, level, gradient, grad_points, start, stop)
