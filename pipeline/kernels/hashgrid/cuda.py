"""CUDA kernels of the hash grid: a thread for each point and level.

`level_params` and the sums are those of `pipeline.kernels.hashgrid.cpu`; only the order of the additions to the
gradient of the table differs, and changes from run to run.
"""

from functools import lru_cache

import numpy as np
import torch
from numba import cuda
from torch import Tensor

from pipeline.kernels.common.cuda import CUDA_OPTIONS, launch
from pipeline.kernels.common.hashing import PRIMES

_PRIME_Y, _PRIME_Z = PRIMES
_ZERO, _ONE = np.float32(0), np.float32(1)


@cuda.jit(device=True)
def _cell(coordinate, cells):
    """Return the cell along one axis and the position in it, of a coordinate of the unit box (clamped; NaN is 0)."""
    scaled = min(max(_ZERO, coordinate), _ONE) * np.float32(cells)
    cell = min(int(scaled), cells - 1)
    return cell, scaled - np.float32(cell)


@cuda.jit(device=True)
def _locate(points, s, level_params, level):
    """Return the cell of a point in the grid of a level (3), and its position in the cell (3)."""
    i, u = _cell(points[s, 0], level_params[level, 0])
    j, v = _cell(points[s, 1], level_params[level, 1])
    k, w = _cell(points[s, 2], level_params[level, 2])
    return (i, j, k), (u, v, w)


@cuda.jit(device=True)
def _row(cell, a, b, c, level_params, level):
    """Return the table row of the corner (a, b, c), each 0 or 1, of a cell."""
    i, j, k = cell[0] + a, cell[1] + b, cell[2] + c
    cells_x, cells_y = level_params[level, 0], level_params[level, 1]
    first, rows, dense = level_params[level, 3], level_params[level, 4], level_params[level, 5]
    if dense == 1:
        return first + i + (cells_x + 1) * (j + (cells_y + 1) * k)
    return first + ((i ^ (j * _PRIME_Y) ^ (k * _PRIME_Z)) & (rows - 1))


@cuda.jit(**CUDA_OPTIONS)
def encode_points(points, table, level_params, count, encoded):
    """Fill the features (n, l*f) of the first `count` points."""
    thread = cuda.grid(1)
    levels, features = level_params.shape[0], table.shape[1]
    if thread >= count * levels:
        return
    s, level = thread // levels, thread % levels
    cell, (u, v, w) = _locate(points, s, level_params, level)
    column = level * features
    for f in range(features):
        encoded[s, column + f] = _ZERO
    for corner in range(8):
        a, b, c = corner & 1, (corner >> 1) & 1, corner >> 2
        weight = (u if a else _ONE - u) * (v if b else _ONE - v) * (w if c else _ONE - w)
        row = _row(cell, a, b, c, level_params, level)
        for f in range(features):
            encoded[s, column + f] += weight * table[row, f]


@cuda.jit(**CUDA_OPTIONS)
def scatter_table_gradient(points, gradient, level_params, count, grad_table):
    """Add the gradient of the table to `grad_table`, from dL/dfeatures = gradient (n, l*f)."""
    thread = cuda.grid(1)
    levels, features = level_params.shape[0], grad_table.shape[1]
    if thread >= count * levels:
        return
    s, level = thread // levels, thread % levels
    column, largest = level * features, _ZERO
    for f in range(features):
        largest = max(largest, abs(gradient[s, column + f]))
    if not largest > _ZERO:
        return
    cell, (u, v, w) = _locate(points, s, level_params, level)
    for corner in range(8):
        a, b, c = corner & 1, (corner >> 1) & 1, corner >> 2
        weight = (u if a else _ONE - u) * (v if b else _ONE - v) * (w if c else _ONE - w)
        row = _row(cell, a, b, c, level_params, level)
        for f in range(features):
            cuda.atomic.add(grad_table, (row, f), weight * gradient[s, column + f])


@cuda.jit(**CUDA_OPTIONS)
def gather_points_gradient(points, table, level_params, gradient, count, grad_points):
    """Add dL/dpoints to `grad_points` (n, 3), from dL/dfeatures = gradient (n, l*f); a thread for each point."""
    s = cuda.grid(1)
    if s >= count:
        return
    features = table.shape[1]
    along_x = along_y = along_z = _ZERO
    for level in range(level_params.shape[0]):
        cell, (u, v, w) = _locate(points, s, level_params, level)
        column = level * features
        for corner in range(8):
            a, b, c = corner & 1, (corner >> 1) & 1, corner >> 2
            weight_x, weight_y, weight_z = u if a else _ONE - u, v if b else _ONE - v, w if c else _ONE - w
            row = _row(cell, a, b, c, level_params, level)
            product = _ZERO
            for f in range(features):
                product += table[row, f] * gradient[s, column + f]
            along_x += (product if a else -product) * weight_y * weight_z * np.float32(level_params[level, 0])
            along_y += (product if b else -product) * weight_x * weight_z * np.float32(level_params[level, 1])
            along_z += (product if c else -product) * weight_x * weight_y * np.float32(level_params[level, 2])
    grad_points[s, 0] += along_x
    grad_points[s, 1] += along_y
    grad_points[s, 2] += along_z


@lru_cache(maxsize=16)
def _on_device(values: tuple[tuple[int, ...], ...], device: torch.device) -> Tensor:
    return torch.tensor(values, dtype=torch.int64, device=device).view(-1, 6)


def level_params_on(device: torch.device, level_params: np.ndarray) -> Tensor:
    """Return `GridLayout.level_params` on a device; the same tensor each time."""
    return _on_device(tuple(map(tuple, level_params.tolist())), device)


def encode(points: Tensor, table: Tensor, level_params: np.ndarray) -> Tensor:
    """Do `pipeline.kernels.hashgrid.encode`, without gradient."""
    features = torch.empty(len(points), len(level_params) * table.shape[1], device=points.device)
    levels = level_params_on(points.device, level_params)
    launch(encode_points, len(points) * len(levels), points, table, levels, len(points), features)
    return features


def add_table_gradient(points: Tensor, gradient: Tensor, grad_table: Tensor, level_params: np.ndarray) -> None:
    """Add the gradient of the table to `grad_table`, from dL/dfeatures = gradient (n, l*f)."""
    levels = level_params_on(points.device, level_params)
    launch(scatter_table_gradient, len(points) * len(levels), points, gradient, levels, len(points), grad_table)


def add_points_gradient(
    points: Tensor, table: Tensor, level_params: np.ndarray, gradient: Tensor, grad_points: Tensor
) -> None:
    """Add dL/dpoints to `grad_points` (n, 3), from dL/dfeatures = gradient (n, l*f)."""
    levels = level_params_on(points.device, level_params)
    launch(gather_points_gradient, len(points), points, table, levels, gradient, len(points), grad_points)
