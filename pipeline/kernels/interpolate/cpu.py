"""Compiled loops of perspective-correct interpolation and its gradient: one pass over the covered pixels each.

Notation: a, b, c corners of the face relative to the pixel centre (px); e_k edge functions at the centre, A their sum;
q_k = e_k / (A z_k), S = q_0 + q_1 + q_2; barycentrics b_k = q_k / S. The gradient is summed on one thread, in the
order of the pixels: views are drawn in parallel, and a copy of the gradient for each thread is as large as the mesh.
"""

import numpy as np
from numba import njit, prange

from pipeline.kernels.common.numba_options import NJIT_OPTIONS


@njit(**NJIT_OPTIONS)
def _geometry(
    face: int, pixel: int, width: int, vertices_px: np.ndarray, depth_m: np.ndarray, faces: np.ndarray
) -> tuple:
    """Return corner indices, corners relative to the pixel centre, A, q and S of a pixel in its face."""
    i, j, k = faces[face, 0], faces[face, 1], faces[face, 2]
    px, py = pixel % width + 0.5, pixel // width + 0.5
    ax, ay = np.float64(vertices_px[i, 0]) - px, np.float64(vertices_px[i, 1]) - py
    bx, by = np.float64(vertices_px[j, 0]) - px, np.float64(vertices_px[j, 1]) - py
    cx, cy = np.float64(vertices_px[k, 0]) - px, np.float64(vertices_px[k, 1]) - py
    e0, e1, e2 = bx * cy - by * cx, cx * ay - cy * ax, ax * by - ay * bx
    area = e0 + e1 + e2
    q0, q1, q2 = e0 / (area * depth_m[i]), e1 / (area * depth_m[j]), e2 / (area * depth_m[k])
    return (i, j, k), (ax, ay, bx, by, cx, cy), area, (q0, q1, q2), q0 + q1 + q2


@njit(**NJIT_OPTIONS)
def _fill_pixel(
    pixel: tuple,
    width: int,
    vertices_px: np.ndarray,
    depth_m: np.ndarray,
    faces: np.ndarray,
    attributes: np.ndarray,
    out: np.ndarray,
) -> None:
    corners, _, _, q, total = _geometry(pixel[1], pixel[0], width, vertices_px, depth_m, faces)
    b0, b1, b2 = q[0] / total, q[1] / total, q[2] / total
    for c in range(attributes.shape[1]):
        out[c] = b0 * attributes[corners[0], c] + b1 * attributes[corners[1], c] + b2 * attributes[corners[2], c]


@njit(parallel=True, **NJIT_OPTIONS)
def interpolate_forward(
    covered: np.ndarray,
    face_ids: np.ndarray,
    width: int,
    vertices_px: np.ndarray,
    depth_m: np.ndarray,
    faces: np.ndarray,
    attributes: np.ndarray,
) -> np.ndarray:
    """Return the attributes (n, c) at the covered pixels."""
    values = np.empty((len(covered), attributes.shape[1]), np.float32)
    for n in prange(len(covered)):
        _fill_pixel((covered[n], face_ids[n]), width, vertices_px, depth_m, faces, attributes, values[n])
    return values


@njit(**NJIT_OPTIONS)
def _add_pixel(
    pixel: tuple,
    width: int,
    vertices_px: np.ndarray,
    depth_m: np.ndarray,
    faces: np.ndarray,
    attributes: np.ndarray,
    upstream: np.ndarray,
    out: np.ndarray,
) -> None:
    """Add the gradient of one pixel to `out` (v, 3 + c): d/dx, d/dy, d/dz, d/dattributes."""
    corners, offsets, area, q, total = _geometry(pixel[1], pixel[0], width, vertices_px, depth_m, faces)
    i, j, k = corners
    ax, ay, bx, by, cx, cy = offsets
    b0, b1, b2 = q[0] / total, q[1] / total, q[2] / total
    g0 = g1 = g2 = 0.0
    for c in range(attributes.shape[1]):
        u = np.float64(upstream[c])
        out[i, 3 + c] += b0 * u
        out[j, 3 + c] += b1 * u
        out[k, 3 + c] += b2 * u
        g0 += u * attributes[i, c]
        g1 += u * attributes[j, c]
        g2 += u * attributes[k, c]
    mean = b0 * g0 + b1 * g1 + b2 * g2
    d0, d1, d2 = (g0 - mean) / total, (g1 - mean) / total, (g2 - mean) / total
    out[i, 2] -= d0 * q[0] / depth_m[i]
    out[j, 2] -= d1 * q[1] / depth_m[j]
    out[k, 2] -= d2 * q[2] / depth_m[k]
    # sum(d_k q_k) is zero, because barycentrics do not change when all q are scaled: A needs no gradient of its own.
    f0, f1, f2 = d0 / (area * depth_m[i]), d1 / (area * depth_m[j]), d2 / (area * depth_m[k])
    out[i, 0] += -f1 * cy + f2 * by
    out[i, 1] += f1 * cx - f2 * bx
    out[j, 0] += f0 * cy - f2 * ay
    out[j, 1] += -f0 * cx + f2 * ax
    out[k, 0] += -f0 * by + f1 * ay
    out[k, 1] += f0 * bx - f1 * ax


@njit(**NJIT_OPTIONS)
def interpolate_backward(
    covered: np.ndarray,
    face_ids: np.ndarray,
    width: int,
    vertices_px: np.ndarray,
    depth_m: np.ndarray,
    faces: np.ndarray,
    attributes: np.ndarray,
    upstream: np.ndarray,
) -> np.ndarray:
    """Return the gradient (v, 3 + c) of position (px), depth and attributes; upstream (n, c): that of the values."""
    total = np.zeros((len(vertices_px), 3 + attributes.shape[1]), np.float32)
    for n in range(len(covered)):
        pixel = (covered[n], face_ids[n])
        _add_pixel(pixel, width, vertices_px, depth_m, faces, attributes, upstream[n], total)
    return total
