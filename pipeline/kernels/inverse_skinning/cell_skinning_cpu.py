"""Compiled loops of one Newton step of inverse skinning, and of its gradient, by the joints of each grid cell.

A point of a cell is moved by the two to five joints that have a weight at a corner of the cell. The loops interpolate
the weights of these joints and blend their matrices, which stay in the cache. `newton_cpu` interpolates matrices that
were blended at all nodes before: the same function of the point, with more memory.

Notation: k frames, j joints, e pairs of a cell with all corners and a joint. Matrices (k, j, 16)
are 4 x 4, row by row; the last row is not read.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from pipeline.kernels.common.numba_options import NJIT_OPTIONS
from pipeline.kernels.inverse_skinning.newton_cpu import invert

_ZERO, _ONE = np.float32(0), np.float32(1)


class CellWeights(NamedTuple):
    """Skin weights by cell: first node (3, m), spacing (m), row of each cell (gx - 1, gy - 1, gz - 1), -1 for none.

    The joints of a row are joint[offsets[row] : offsets[row + 1]]; weight (e, 8) holds their weights at the corners, of
    which x changes fastest.
    """

    origin: np.ndarray
    spacing: np.float32
    row_of_cell: np.ndarray
    offsets: np.ndarray
    joint: np.ndarray
    weight: np.ndarray


@njit(**NJIT_OPTIONS)
def weights_by_cell(row_of_node, node_offsets, node_joint, node_weight, joints):
    """Return `row_of_cell`, `offsets`, `joint` and `weight` of `CellWeights` from the nonzero weights of the nodes."""
    size_x, size_y, size_z = row_of_node.shape[0] - 1, row_of_node.shape[1] - 1, row_of_node.shape[2] - 1
    row_of_cell = np.full((max(size_x, 0), max(size_y, 0), max(size_z, 0)), -1, np.int32)
    offsets = np.zeros(row_of_cell.size + 1, np.int64)
    capacity = max(8 * len(node_joint), 1)
    joint, weight = np.empty(capacity, np.int32), np.zeros((capacity, 8), np.float32)
    slot_of_joint, rows, count = np.full(joints, -1), 0, 0
    for i in range(size_x):
        for j in range(size_y):
            for k in range(size_z):
                complete = True
                for corner in range(8):
                    complete &= row_of_node[i + (corner & 1), j + ((corner >> 1) & 1), k + (corner >> 2)] >= 0
                if not complete:
                    continue
                for corner in range(8):
                    node = row_of_node[i + (corner & 1), j + ((corner >> 1) & 1), k + (corner >> 2)]
                    for entry in range(node_offsets[node], node_offsets[node + 1]):
                        if slot_of_joint[node_joint[entry]] < offsets[rows]:
                            slot_of_joint[node_joint[entry]], joint[count] = count, node_joint[entry]
                            count += 1
                        weight[slot_of_joint[node_joint[entry]], corner] = node_weight[entry]
                row_of_cell[i, j, k] = rows
                rows += 1
                offsets[rows] = count
    return row_of_cell, offsets[: rows + 1].copy(), joint[:count].copy(), weight[:count].copy()


@njit(**NJIT_OPTIONS)
def weight_and_slopes(weight, entry, u, v, w, inverse_spacing):
    """Return the weight of a pair at the place (u, v, w) in its cell, and its derivatives by x, y and z, 1/m."""
    w0, w1, w2, w3 = weight[entry, 0], weight[entry, 1], weight[entry, 2], weight[entry, 3]
    w4, w5, w6, w7 = weight[entry, 4], weight[entry, 5], weight[entry, 6], weight[entry, 7]
    # Slopes along x at the four edges, then values and slopes along y at two, then along z.
    d0, d1, d2, d3 = w1 - w0, w3 - w2, w5 - w4, w7 - w6
    a0, a1, a2, a3 = w0 + u * d0, w2 + u * d1, w4 + u * d2, w6 + u * d3
    b0, b1 = a1 - a0, a3 - a2
    c0, c1 = a0 + v * b0, a2 + v * b1
    e0, e1 = d0 + v * (d1 - d0), d2 + v * (d3 - d2)
    along_x, along_y = (e0 + w * (e1 - e0)) * inverse_spacing, (b0 + w * (b1 - b0)) * inverse_spacing
    return c0 + w * (c1 - c0), along_x, along_y, (c1 - c0) * inverse_spacing


@njit(**NJIT_OPTIONS)
def _row_and_product(matrices, frame, m, first, x, y, z):
    """Return three entries of a row of a matrix, from entry `first` on, and the row times (x, y, z, 1)."""
    m0, m1, m2 = matrices[frame, m, first], matrices[frame, m, first + 1], matrices[frame, m, first + 2]
    return m0, m1, m2, m0 * x + m1 * y + m2 * z + matrices[frame, m, first + 3]


@njit(**NJIT_OPTIONS)
def newton_steps(first, last, ray_indices, batch_index, matrices, cells, canonical, points, inverse_jacobian):
    """Move the points first..last by one Newton step from `canonical` (s, 3) to the inverse of the posed `points`.

    points (s, 3): posed positions; replaced by the canonical positions after the step, which are those before it where
    no step is possible. The frame of sample s is batch_index[ray_indices[s]]. Fills `inverse_jacobian` (s, 9) with that
    of the step, or with zeros.
    """
    origin, spacing, row_of_cell, offsets, joint, weight = cells
    origin_x, origin_y, origin_z, inverse = origin[0], origin[1], origin[2], _ONE / spacing
    size_x, size_y, size_z = row_of_cell.shape
    for s in range(first, last):
        x, y, z = canonical[s, 0], canonical[s, 1], canonical[s, 2]
        u, v, w = (x - origin_x) * inverse, (y - origin_y) * inverse, (z - origin_z) * inverse
        floor_u, floor_v, floor_w = np.floor(u), np.floor(v), np.floor(w)
        i, j, k = int(floor_u), int(floor_v), int(floor_w)
        u, v, w = u - floor_u, v - floor_v, w - floor_w
        row = np.int32(-1)
        if 0 <= i < size_x and 0 <= j < size_y and 0 <= k < size_z:
            row = row_of_cell[i, j, k]
        px = py = pz = _ZERO
        j00 = j01 = j02 = j10 = j11 = j12 = j20 = j21 = j22 = _ZERO
        if row >= 0:
            frame = batch_index[ray_indices[s]]
            for entry in range(offsets[row], offsets[row + 1]):
                value, along_x, along_y, along_z = weight_and_slopes(weight, entry, u, v, w, inverse)
                m = joint[entry]
                m0, m1, m2, q = _row_and_product(matrices, frame, m, 0, x, y, z)
                px += value * q
                j00 += value * m0 + along_x * q
                j01 += value * m1 + along_y * q
                j02 += value * m2 + along_z * q
                m0, m1, m2, q = _row_and_product(matrices, frame, m, 4, x, y, z)
                py += value * q
                j10 += value * m0 + along_x * q
                j11 += value * m1 + along_y * q
                j12 += value * m2 + along_z * q
                m0, m1, m2, q = _row_and_product(matrices, frame, m, 8, x, y, z)
                pz += value * q
                j20 += value * m0 + along_x * q
                j21 += value * m1 + along_y * q
                j22 += value * m2 + along_z * q
        invertible, (a, b, c, d, e, f, g, h, q) = invert((j00, j01, j02, j10, j11, j12, j20, j21, j22))
        if invertible:
            rx, ry, rz = points[s, 0] - px, points[s, 1] - py, points[s, 2] - pz
            x, y, z = x + a * rx + b * ry + c * rz, y + d * rx + e * ry + f * rz, z + g * rx + h * ry + q * rz
        points[s, 0], points[s, 1], points[s, 2] = x, y, z
        inverse_jacobian[s, 0], inverse_jacobian[s, 1], inverse_jacobian[s, 2] = a, b, c
        inverse_jacobian[s, 3], inverse_jacobian[s, 4], inverse_jacobian[s, 5] = d, e, f
        inverse_jacobian[s, 6], inverse_jacobian[s, 7], inverse_jacobian[s, 8] = g, h, q


@njit(**NJIT_OPTIONS)
def add_matrix_gradient(rows, frames, canonical, inverse_jacobian, gradient, cells, grad_matrices):
    """Add dL/dmatrices to `grad_matrices` (k, j, 16), from dL/dpoint = gradient (r, 3) of the samples `rows` (r).

    Implicit function theorem, as in `newton_cpu.add_pose_gradient`. frames (r): frame of each row.
    """
    origin, spacing, row_of_cell, offsets, joint, weight = cells
    origin_x, origin_y, origin_z, inverse = origin[0], origin[1], origin[2], _ONE / spacing
    for index in range(len(rows)):
        s, frame = rows[index], frames[index]
        gx, gy, gz = gradient[index, 0], gradient[index, 1], gradient[index, 2]
        lx = -(inverse_jacobian[s, 0] * gx + inverse_jacobian[s, 3] * gy + inverse_jacobian[s, 6] * gz)
        ly = -(inverse_jacobian[s, 1] * gx + inverse_jacobian[s, 4] * gy + inverse_jacobian[s, 7] * gz)
        lz = -(inverse_jacobian[s, 2] * gx + inverse_jacobian[s, 5] * gy + inverse_jacobian[s, 8] * gz)
        # Not `== 0`, which is false for NaN: a point outside the grid, whose inverse Jacobian is zero, has no cell.
        if not abs(lx) + abs(ly) + abs(lz) > _ZERO:
            continue
        x, y, z = canonical[s, 0], canonical[s, 1], canonical[s, 2]
        u, v, w = (x - origin_x) * inverse, (y - origin_y) * inverse, (z - origin_z) * inverse
        floor_u, floor_v, floor_w = np.floor(u), np.floor(v), np.floor(w)
        row = row_of_cell[int(floor_u), int(floor_v), int(floor_w)]
        u, v, w = u - floor_u, v - floor_v, w - floor_w
        for entry in range(offsets[row], offsets[row + 1]):
            a0 = weight[entry, 0] + u * (weight[entry, 1] - weight[entry, 0])
            a1 = weight[entry, 2] + u * (weight[entry, 3] - weight[entry, 2])
            a2 = weight[entry, 4] + u * (weight[entry, 5] - weight[entry, 4])
            a3 = weight[entry, 6] + u * (weight[entry, 7] - weight[entry, 6])
            c0, c1 = a0 + v * (a1 - a0), a2 + v * (a3 - a2)
            value, m = c0 + w * (c1 - c0), joint[entry]
            wx, wy, wz = value * lx, value * ly, value * lz
            grad_matrices[frame, m, 0] += wx * x
            grad_matrices[frame, m, 1] += wx * y
            grad_matrices[frame, m, 2] += wx * z
            grad_matrices[frame, m, 3] += wx
            grad_matrices[frame, m, 4] += wy * x
            grad_matrices[frame, m, 5] += wy * y
            grad_matrices[frame, m, 6] += wy * z
            grad_matrices[frame, m, 7] += wy
            grad_matrices[frame, m, 8] += wz * x
            grad_matrices[frame, m, 9] += wz * y
            grad_matrices[frame, m, 10] += wz * z
            grad_matrices[frame, m, 11] += wz
