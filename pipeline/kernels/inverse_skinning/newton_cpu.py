"""Compiled loops of skinning through a grid and of one Newton step back, with its gradient.

Forward, a canonical point x is carried by A(x) = sum_j w_j(x) B_j, whose 12 numbers are interpolated trilinearly
between the nodes of the skin grid. Inverse, x(p) solves A(x) x = p: Newton's method with the exact Jacobian
J = A_3x3 + sum_corners (A_corner x) grad(weight_corner)^T.

Grid arguments, everywhere: origin (3), cell (m), row_of_node (gx, gy, gz) int32 with -1 where the grid has no node,
blended (m, k, 12), the rows of A (3, 4) at the nodes that exist, for each of k frames.
"""

import numpy as np
from numba import njit, prange

from pipeline.kernels.common.numba_options import NJIT_OPTIONS

_ZERO, _ONE = np.float32(0), np.float32(1)
BLOCK = 256


@njit(**NJIT_OPTIONS)
def apply_affine(m, x, y, z):
    """m (12 numbers, a 3 x 4 matrix by rows) times (x, y, z, 1)."""
    return (
        m[0] * x + m[1] * y + m[2] * z + m[3],
        m[4] * x + m[5] * y + m[6] * z + m[7],
        m[8] * x + m[9] * y + m[10] * z + m[11],
    )


@njit(**NJIT_OPTIONS)
def skin_point(x, y, z, frame, origin, cell, row_of_node, blended):
    """Posed position of a canonical point and the Jacobian, as 13 numbers: inside, position, J by rows."""
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
            j00, j01, j02 = (
                j00 + weight * m[0] + along_x * qx,
                j01 + weight * m[1] + along_y * qx,
                j02 + weight * m[2] + along_z * qx,
            )
            j10, j11, j12 = (
                j10 + weight * m[4] + along_x * qy,
                j11 + weight * m[5] + along_y * qy,
                j12 + weight * m[6] + along_z * qy,
            )
            j20, j21, j22 = (
                j20 + weight * m[8] + along_x * qz,
                j21 + weight * m[9] + along_y * qz,
                j22 + weight * m[10] + along_z * qz,
            )
    return inside, px, py, pz, j00, j01, j02, j10, j11, j12, j20, j21, j22


@njit(**NJIT_OPTIONS)
def invert(j00, j01, j02, j10, j11, j12, j20, j21, j22):
    """Inverse of a 3x3 matrix by rows, and whether it is far from singular."""
    c00, c01, c02 = j11 * j22 - j12 * j21, j12 * j20 - j10 * j22, j10 * j21 - j11 * j20
    determinant = j00 * c00 + j01 * c01 + j02 * c02
    invertible = abs(determinant) > np.float32(1e-3)
    s = _ONE / determinant if invertible else _ZERO
    return (
        invertible,
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


@njit(**NJIT_OPTIONS)
def newton_step(px, py, pz, x, y, z, frame, origin, cell, row_of_node, blended, inverse_jacobian):
    """Where one step from (x, y, z) comes nearer to A(x) x = p: the start itself where a step is not possible.

    Fills the step's inverse Jacobian (9) by rows, or zeros.
    """
    inside, qx, qy, qz, a, b, c, d, e, f, g, h, k = skin_point(x, y, z, frame, origin, cell, row_of_node, blended)
    invertible, a, b, c, d, e, f, g, h, k = invert(a, b, c, d, e, f, g, h, k)
    if inside and invertible:
        rx, ry, rz = px - qx, py - qy, pz - qz
        x, y, z = x + a * rx + b * ry + c * rz, y + d * rx + e * ry + f * rz, z + g * rx + h * ry + k * rz
    else:
        a = b = c = d = e = f = g = h = k = _ZERO
    inverse_jacobian[0], inverse_jacobian[1], inverse_jacobian[2] = a, b, c
    inverse_jacobian[3], inverse_jacobian[4], inverse_jacobian[5] = d, e, f
    inverse_jacobian[6], inverse_jacobian[7], inverse_jacobian[8] = g, h, k
    return x, y, z


@njit(parallel=True, **NJIT_OPTIONS)
def newton_step_batch(points_posed, start, batch_index, origin, cell, row_of_node, blended, refined, inverse_jacobian):
    """`newton_step` for each point (s, 3) from its start.

    slot (s) says which frame of `blended` a point belongs to. inverse_jacobian (s, 9): that of the step, or zeros.
    """
    count = points_posed.shape[0]
    for block in prange((count + BLOCK - 1) // BLOCK):
        for s in range(block * BLOCK, min(block * BLOCK + BLOCK, count)):
            refined[s, 0], refined[s, 1], refined[s, 2] = newton_step(
                points_posed[s, 0], points_posed[s, 1], points_posed[s, 2], start[s, 0], start[s, 1], start[s, 2],
                batch_index[s], origin, cell, row_of_node, blended, inverse_jacobian[s],
            )  # fmt: skip


@njit(parallel=True, **NJIT_OPTIONS)
def add_pose_gradient(points, inverse_jacobian, gradient, frame_offsets, origin, cell, row_of_node, grad_blended):
    """Add dL/dA (m, frames, 12) for dL/dx = gradient, where x solves A(x) x = p: dL/d(A x) = -J^-T dL/dx.

    points (s, 3) and inverse_jacobian (s, 9) are the starts and what `newton_step_batch` found there; the samples of
    frame f are
    slot_start[f] : slot_start[f + 1]. A thread owns whole frames.
    """
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
            # Not `== 0`: a NaN would go on, and a point outside, whose m is zeros, has no nodes to add to.
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
