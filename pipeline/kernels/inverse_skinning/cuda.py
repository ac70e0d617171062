"""CUDA kernels of the Newton step of inverse skinning and of its gradient: a thread for each sample.

They do what `pipeline.kernels.inverse_skinning.cell_skinning_cpu` does, by the joints of each grid cell.
"""

from typing import Any, NamedTuple

import numpy as np
import torch
from numba import cuda
from torch import Tensor

from pipeline.kernels.common.cuda import CUDA_OPTIONS, device_function, launch
from pipeline.kernels.inverse_skinning.cell_skinning_cpu import CellWeights, weight_and_slopes

_ZERO, _ONE, _MIN_DETERMINANT = np.float32(0), np.float32(1), np.float32(1e-3)

_weight_and_slopes = device_function(weight_and_slopes)


class CellTensors(NamedTuple):
    """See `pipeline.kernels.inverse_skinning.cell_skinning_cpu.CellWeights`."""

    origin: Tensor
    spacing: np.float32
    row_of_cell: Tensor
    offsets: Tensor
    joint: Tensor
    weight: Tensor


class FrameTensors(NamedTuple):
    """Frame of the batch that each ray belongs to, matrices (k, j, 16) of the frames, and skin weights by cell."""

    batch_index: Tensor
    matrices: Tensor
    cells: CellTensors


@cuda.jit(device=True)
def _cell_of(x, y, z, cells):
    """Return the row of the cell of a canonical point, -1 for none, and the place of the point in it."""
    inverse, size = _ONE / cells.spacing, cells.row_of_cell.shape
    u, v, w = (x - cells.origin[0]) * inverse, (y - cells.origin[1]) * inverse, (z - cells.origin[2]) * inverse
    row = -1
    # False for NaN, too.
    if _ZERO <= u < np.float32(size[0]) and _ZERO <= v < np.float32(size[1]) and _ZERO <= w < np.float32(size[2]):
        row = cells.row_of_cell[int(u), int(v), int(w)]
        u, v, w = u - np.float32(int(u)), v - np.float32(int(v)), w - np.float32(int(w))
    return row, u, v, w


@cuda.jit(**CUDA_OPTIONS)
def step_samples(canonical, distance, ray_indices, rays, frames, points, inverse_jacobian):
    """Fill canonical points after a Newton step and the inverse Jacobians of it: see `newton_steps`."""
    s = cuda.grid(1)
    if s >= distance.shape[0]:
        return
    batch_index, matrices, cells = frames
    x, y, z, ray, t = canonical[s, 0], canonical[s, 1], canonical[s, 2], ray_indices[s], distance[s]
    for entry in range(9):
        inverse_jacobian[s, entry] = _ZERO
    points[s, 0], points[s, 1], points[s, 2] = x, y, z
    row, u, v, w = _cell_of(x, y, z, cells)
    if row < 0:
        return
    frame, weight, inverse = batch_index[ray], cells.weight, _ONE / cells.spacing
    px = py = pz = _ZERO
    j00 = j01 = j02 = j10 = j11 = j12 = j20 = j21 = j22 = _ZERO
    for entry in range(cells.offsets[row], cells.offsets[row + 1]):
        value, along_x, along_y, along_z = _weight_and_slopes(weight, entry, u, v, w, inverse)
        m = cells.joint[entry]
        m0, m1, m2 = matrices[frame, m, 0], matrices[frame, m, 1], matrices[frame, m, 2]
        q = m0 * x + m1 * y + m2 * z + matrices[frame, m, 3]
        px += value * q
        j00, j01, j02 = j00 + value * m0 + along_x * q, j01 + value * m1 + along_y * q, j02 + value * m2 + along_z * q
        m0, m1, m2 = matrices[frame, m, 4], matrices[frame, m, 5], matrices[frame, m, 6]
        q = m0 * x + m1 * y + m2 * z + matrices[frame, m, 7]
        py += value * q
        j10, j11, j12 = j10 + value * m0 + along_x * q, j11 + value * m1 + along_y * q, j12 + value * m2 + along_z * q
        m0, m1, m2 = matrices[frame, m, 8], matrices[frame, m, 9], matrices[frame, m, 10]
        q = m0 * x + m1 * y + m2 * z + matrices[frame, m, 11]
        pz += value * q
        j20, j21, j22 = j20 + value * m0 + along_x * q, j21 + value * m1 + along_y * q, j22 + value * m2 + along_z * q
    c00, c01, c02 = j11 * j22 - j12 * j21, j12 * j20 - j10 * j22, j10 * j21 - j11 * j20
    determinant = j00 * c00 + j01 * c01 + j02 * c02
    if not abs(determinant) > _MIN_DETERMINANT:
        return
    scale = _ONE / determinant
    a, b, c = scale * c00, scale * (j02 * j21 - j01 * j22), scale * (j01 * j12 - j02 * j11)
    d, e, f = scale * c01, scale * (j00 * j22 - j02 * j20), scale * (j02 * j10 - j00 * j12)
    g, h, i = scale * c02, scale * (j01 * j20 - j00 * j21), scale * (j00 * j11 - j01 * j10)
    rx = rays.origins_m[ray, 0] + t * rays.directions[ray, 0] - px
    ry = rays.origins_m[ray, 1] + t * rays.directions[ray, 1] - py
    rz = rays.origins_m[ray, 2] + t * rays.directions[ray, 2] - pz
    points[s, 0] = x + a * rx + b * ry + c * rz
    points[s, 1] = y + d * rx + e * ry + f * rz
    points[s, 2] = z + g * rx + h * ry + i * rz
    inverse_jacobian[s, 0], inverse_jacobian[s, 1], inverse_jacobian[s, 2] = a, b, c
    inverse_jacobian[s, 3], inverse_jacobian[s, 4], inverse_jacobian[s, 5] = d, e, f
    inverse_jacobian[s, 6], inverse_jacobian[s, 7], inverse_jacobian[s, 8] = g, h, i


@cuda.jit(**CUDA_OPTIONS)
def scatter_matrix_gradient(canonical, ray_indices, frames, inverse_jacobian, gradient, grad_matrices):
    """Add dL/dmatrices to `grad_matrices` (k, j, 16): see `add_matrix_gradient`."""
    s = cuda.grid(1)
    if s >= canonical.shape[0]:
        return
    gx, gy, gz = gradient[s, 0], gradient[s, 1], gradient[s, 2]
    lx = -(inverse_jacobian[s, 0] * gx + inverse_jacobian[s, 3] * gy + inverse_jacobian[s, 6] * gz)
    ly = -(inverse_jacobian[s, 1] * gx + inverse_jacobian[s, 4] * gy + inverse_jacobian[s, 7] * gz)
    lz = -(inverse_jacobian[s, 2] * gx + inverse_jacobian[s, 5] * gy + inverse_jacobian[s, 8] * gz)
    if not abs(lx) + abs(ly) + abs(lz) > _ZERO:
        return
    x, y, z = canonical[s, 0], canonical[s, 1], canonical[s, 2]
    batch_index, _, cells = frames
    row, u, v, w = _cell_of(x, y, z, cells)
    frame = batch_index[ray_indices[s]]
    for entry in range(cells.offsets[row], cells.offsets[row + 1]):
        value, _, _, _ = _weight_and_slopes(cells.weight, entry, u, v, w, _ONE)
        m = cells.joint[entry]
        for axis in range(3):
            scaled = value * (lx if axis == 0 else (ly if axis == 1 else lz))
            cuda.atomic.add(grad_matrices, (frame, m, 4 * axis), scaled * x)
            cuda.atomic.add(grad_matrices, (frame, m, 4 * axis + 1), scaled * y)
            cuda.atomic.add(grad_matrices, (frame, m, 4 * axis + 2), scaled * z)
            cuda.atomic.add(grad_matrices, (frame, m, 4 * axis + 3), scaled)


def newton_steps(
    canonical: Tensor, distance: Tensor, ray_indices: Tensor, rays: Any, frames: FrameTensors
) -> tuple[Tensor, Tensor]:
    """Return samples (s, 3) moved by one Newton step to the inverses of their posed positions, and the inverse
    Jacobians (s, 9) of the step, zero where none is possible.

    rays: `pipeline.kernels.march.Rays`.
    """
    points, inverse_jacobian = torch.empty_like(canonical), canonical.new_empty(len(canonical), 9)
    inputs = canonical, distance, ray_indices, rays, frames
    launch(step_samples, len(canonical), *inputs, points, inverse_jacobian)
    return points, inverse_jacobian


def add_matrix_gradient(
    canonical: Tensor,
    ray_indices: Tensor,
    frames: FrameTensors,
    inverse_jacobian: Tensor,
    gradient: Tensor,
    grad_matrices: Tensor,
) -> None:
    """Add dL/dmatrices to `grad_matrices` (k, j, 16), from dL/dpoint = gradient (s, 3)."""
    inputs = canonical, ray_indices, frames, inverse_jacobian, gradient
    launch(scatter_matrix_gradient, len(canonical), *inputs, grad_matrices)


def cells_on(device: torch.device, cells: CellWeights) -> CellTensors:
    """Return the arrays of `SkinGrid.cell_weights` as tensors on a device."""
    origin, spacing, *arrays = cells
    moved = (torch.from_numpy(array).to(device) for array in (origin, *arrays))
    return CellTensors(next(moved), spacing, *moved)
