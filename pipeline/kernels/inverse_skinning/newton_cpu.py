"""Compiled loops of grid-based skinning and of one Newton step of its inverse, with the gradient.

Forward: the canonical point x moves to A(x) x with A(x) = sum_j w_j(x) B_j, whose 12 entries are interpolated
trilinearly between the nodes of the skin grid. Inverse: x(p) solves A(x) x = p by Newton's method with the exact
Jacobian J = A_3x3 + sum_corners (A_corner x) grad(weight_corner)^T.

Notation: `blended` (m, k, 12) holds the rows of A (3 x 4) at the m nodes that exist, for each of k frames. A 3 x 3
matrix is a tuple of 9 numbers, row by row.
"""

from typing import NamedTuple

import numpy as np
from numba import njit, prange

from pipeline.kernels.common.numba_options import NJIT_OPTIONS

_ZERO, _ONE = np.float32(0), np.float32(1)
BLOCK = 256


class LatticeArrays(NamedTuple):
    """Node positions of a skin grid: first node (3, m), spacing (m), and row of each node (gx, gy, gz), -1 for none."""

    origin: np.ndarray
    cell: np.float32
    row_of_node: np.ndarray


@njit(**NJIT_OPTIONS)
def apply_affine(m, x, y, z):
    """Return m (x, y, z, 1) for a 3 x 4 matrix m of 12 numbers, row by row."""
    return (
        m[0] * x + m[1] * y + m[2] * z + m[3],
        m[4] * x + m[5] * y + m[6] * z + m[7],
        m[8] * x + m[9] * y + m[10] * z + m[11],
    )


@njit(**NJIT_OPTIONS)
def skin_point(point, frame, lattice, blended):
    """Return whether a canonical point is inside the grid, its posed position (3) and the Jacobian J (9)."""
    x, y, z = point
    origin, cell, row_of_node = lattice
    inverse = _ONE / cell
    gx, gy, gz = (x - origin[0]) * inverse, (y - origin[1]) * inverse, (z - origin[2]) * inverse
    i, j, k = int(np.floor(gx)), int(np.floor(gy)), int(np.floor(gz))
    px = py = pz = _ZERO
    j00 = j01 = j02 = j10 = j11 = j12 = j20 = j21 = j22 = _ZERO
    inside = (
        0 <= i < row_of_node.shape[0] - 1 and 0 <= j < row_of_node.shape[1] - 1 and 0 <= k < row_of_node.shape[2] - 1
    )
    if inside:
        u, v, w = gx - np.float32(i), gy - np.float32(j), gz - np.float32(k)
        for corner in range(8):
            a, b, c = corner & 1, (corner >> 1) & 1, corner >> 2
            row = row_of_node[i + a, j + b, k + c]
            if row < 0:
                inside = False
                break
            wx, dx = (u, inverse) if a == 1 else (_ONE - u, -inverse)
            wy, dy = (v, inverse) if b == 1 else (_ONE - v, -inverse)
            wz, dz = (w, inverse) if c == 1 else (_ONE - w, -inverse)
            m = blended[row, frame]
            qx, qy, qz = apply_affine(m, x, y, z)
            weight, along_x, along_y, along_z = wx * wy * wz, dx * wy * wz, wx * dy * wz, wx * wy * dz
            px, py, pz = px + weight * qx, py + weight * qy, pz + weight * qz
            j00 = j00 + weight * m[0] + along_x * qx
            j01 = j01 + weight * m[1] + along_y * qx
            j02 = j02 + weight * m[2] + along_z * qx
            j10 = j10 + weight * m[4] + along_x * qy
            j11 = j11 + weight * m[5] + along_y * qy
            j12 = j12 + weight * m[6] + along_z * qy
            j20 = j20 + weight * m[8] + along_x * qz
            j21 = j21 + weight * m[9] + along_y * qz
            j22 = j22 + weight * m[10] + along_z * qz
    return inside, (px, py, pz), (j00, j01, j02, j10, j11, j12, j20, j21, j22)


@njit(**NJIT_OPTIONS)
def invert(matrix):
    """Return whether a 3 x 3 matrix (9) is invertible (|determinant| > 1e-3), and its inverse (9), zeros if not."""
    j00, j01, j02, j10, j11, j12, j20, j21, j22 = matrix
    c00, c01, c02 = j11 * j22 - j12 * j21, j12 * j20 - j10 * j22, j10 * j21 - j11 * j20
    determinant = j00 * c00 + j01 * c01 + j02 * c02
    invertible = abs(determinant) > np.float32(1e-3)
    s = _ONE / determinant if invertible else _ZERO
    inverse = (
        s * c00,
        s * (j02 * j21 - j01 * j22),
        s * (j01 * j12 - j02 * j11),
        s * c01,
        s * (j00 * j22 - j02 * j20),
        s * (j02 * j10 - j00 * j12),
        s * c02,
        s * (j01 * j20 - j00 * j21),
        s * (j00 * j11 - j01 * j10),
    )
    return invertible, inverse


@njit(**NJIT_OPTIONS)
def newton_step(target, start, frame, lattice, blended, inverse_jacobian):
    """Return the point after one Newton step from `start` towards A(x) x = target; `start` if no step is possible.

    Fills `inverse_jacobian` (9) with that of the step, or with zeros.
    """
    x, y, z = start
    inside, (qx, qy, qz), jacobian = skin_point(start, frame, lattice, blended)
    invertible, (a, b, c, d, e, f, g, h, k) = invert(jacobian)
    if inside and invertible:
        rx, ry, rz = target[0] - qx, target[1] - qy, target[2] - qz
        x, y, z = x + a * rx + b * ry + c * rz, y + d * rx + e * ry + f * rz, z + g * rx + h * ry + k * rz
    else:
        a = b = c = d = e = f = g = h = k = _ZERO
    inverse_jacobian[0], inverse_jacobian[1], inverse_jacobian[2] = a, b, c
    inverse_jacobian[3], inverse_jacobian[4], inverse_jacobian[5] = d, e, f
    inverse_jacobian[6], inverse_jacobian[7], inverse_jacobian[8] = g, h, k
    return x, y, z


@njit(parallel=True, **NJIT_OPTIONS)
def newton_step_batch(posed, start, batch_index, lattice, blended, refined, inverse_jacobian):
    """Fill `refined` (s, 3) and `inverse_jacobian` (s, 9): `newton_step` for each posed point (s, 3) from its start.

    batch_index (s): frame of `blended` that each point belongs to.
    """
    count = posed.shape[0]
    for block in prange((count + BLOCK - 1) // BLOCK):
        for s in range(block * BLOCK, min(block * BLOCK + BLOCK, count)):
            target, first = (posed[s, 0], posed[s, 1], posed[s, 2]), (start[s, 0], start[s, 1], start[s, 2])
            refined[s, 0], refined[s, 1], refined[s, 2] = newton_step(
                target, first, batch_index[s], lattice, blended, inverse_jacobian[s]
            )


@njit(parallel=True, **NJIT_OPTIONS)
def add_pose_gradient(points, inverse_jacobian, gradient, frame_offsets, lattice, grad_blended):
    """Add dL/dA to `grad_blended` (m, k, 12) for gradient = dL/dx (s, 3), where x solves A(x) x = p.

    Implicit function theorem: dL/d(A x) = -J^-T dL/dx. points (s, 3) and inverse_jacobian (s, 9) are the starts and the
    output of `newton_step_batch`. The samples of frame f are frame_offsets[f] : frame_offsets[f + 1]; each thread
    writes whole frames.
    """
    origin, cell, row_of_node = lattice
    inverse = _ONE / cell
    for frame in prange(frame_offsets.shape[0] - 1):
        for s in range(frame_offsets[frame], frame_offsets[frame + 1]):
            gx, gy, gz = gradient[s, 0], gradient[s, 1], gradient[s, 2]
            if gx == _ZERO and gy == _ZERO and gz == _ZERO:
                continue
            m = inverse_jacobian[s]
            lx = -(m[0] * gx + m[3] * gy + m[6] * gz)
            ly = -(m[1] * gx + m[4] * gy + m[7] * gz)
            lz = -(m[2] * gx + m[5] * gy + m[8] * gz)
            # Not `== 0`, which is false for NaN: a point outside the grid, whose m is zeros, has no nodes.
            if not abs(lx) + abs(ly) + abs(lz) > _ZERO:
                continue
            x, y, z = points[s, 0], points[s, 1], points[s, 2]
            ui, uj, uk = (x - origin[0]) * inverse, (y - origin[1]) * inverse, (z - origin[2]) * inverse
            i, j, k = int(np.floor(ui)), int(np.floor(uj)), int(np.floor(uk))
            ui, uj, uk = ui - np.float32(i), uj - np.float32(j), uk - np.float32(k)
            for corner in range(8):
                p, q, r = corner & 1, (corner >> 1) & 1, corner >> 2
                weight = (ui if p == 1 else _ONE - ui) * (uj if q == 1 else _ONE - uj) * (uk if r == 1 else _ONE - uk)
                target = grad_blended[row_of_node[i + p, j + q, k + r], frame]
                wx, wy, wz = weight * lx, weight * ly, weight * lz
                target[0] += wx * x
                target[1] += wx * y
                target[2] += wx * z
                target[3] += wx
                target[4] += wy * x
                target[5] += wy * y
                target[6] += wy * z
                target[7] += wy
                target[8] += wz * x
                target[9] += wz * y
                target[10] += wz * z
                target[11] += wz
