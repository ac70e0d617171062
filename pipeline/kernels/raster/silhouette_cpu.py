"""Compiled loops of silhouette antialiasing; `pipeline.kernels.raster.reference` defines what they do.

Notation: an edge runs from start to end, its face lies on the side of the apex. Along an axis (0: x, 1: y), it crosses
lines of pixel centres; t is the fraction of the edge from start to end at a crossing, low the pixel before it.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from pipeline.kernels.common.numba_options import NJIT_OPTIONS


@njit(**NJIT_OPTIONS)
def _first_line(across: float, lines: int) -> int:
    """Return the first line of pixel centres at or after a position, clamped to [0, lines]."""
    return int(np.ceil(min(max(across - np.float32(0.5), np.float32(0.0)), np.float32(lines))))


class BlendArrays(NamedTuple):
    """Blends as `silhouette_blends_cpu` returns them, with room for more.

    distance: of the crossing from the near pixel, px; negative if another crossing between the same pixels is farther.
    """

    pixels: np.ndarray
    fraction: np.ndarray
    ends: np.ndarray
    derivatives: np.ndarray
    distance: np.ndarray


@njit(**NJIT_OPTIONS)
def _count_crossings(vertices_px: np.ndarray, edges: np.ndarray, axis: int, lines: int) -> int:
    """Return the number of crossings of all edges with the lines along an axis."""
    count = 0
    for s in range(edges.shape[0]):
        start, end = vertices_px[edges[s, 0], 1 - axis], vertices_px[edges[s, 1], 1 - axis]
        count += _first_line(max(start, end), lines) - _first_line(min(start, end), lines)
    return count


@njit(**NJIT_OPTIONS)
def _pixels_of_crossing(
    face_id: np.ndarray, depth: np.ndarray, line: int, low: int, axis: int, outward: int, inverse_depth: float
) -> tuple:
    """Return the row-major indices of the pixels (near, far) of a crossing; near is -1 if they are not blended."""
    along_x, along_y = 1 - axis, axis
    low_x, low_y = (low, line) if axis == 0 else (line, low)
    near_x, near_y = low_x + along_x * (outward < 0), low_y + along_y * (outward < 0)
    far_x, far_y = low_x + along_x * (outward > 0), low_y + along_y * (outward > 0)
    is_seen = (
        depth[near_y, near_x] < depth[far_y, far_x]
        and depth[far_y, far_x] * inverse_depth > 1.0
        and face_id[near_y, near_x] != face_id[far_y, far_x]
    )
    width = face_id.shape[1]
    return (near_y * width + near_x if is_seen else -1), far_y * width + far_x


@njit(**NJIT_OPTIONS)
def _add_along_axis(
    face_id: np.ndarray,
    depth: np.ndarray,
    vertices_px: np.ndarray,
    depth_m: np.ndarray,
    edges: np.ndarray,
    axis: int,
    blends: BlendArrays,
    count: int,
) -> int:
    """Write the blends along an axis from row `count` on; return the row after the last one."""
    lines, size = (face_id.shape[0], face_id.shape[1]) if axis == 0 else (face_id.shape[1], face_id.shape[0])
    half, one = np.float32(0.5), np.float32(1.0)
    row_of_pair = np.full(face_id.size, -1, np.int64)
    for s in range(edges.shape[0]):
        i, j, k = edges[s, 0], edges[s, 1], edges[s, 2]
        if not (depth_m[i] > 0.0 and depth_m[j] > 0.0 and depth_m[k] > 0.0):
            continue
        start_along, start_across = vertices_px[i, axis], vertices_px[i, 1 - axis]
        along, across = vertices_px[j, axis] - start_along, vertices_px[j, 1 - axis] - start_across
        first = _first_line(min(start_across, vertices_px[j, 1 - axis]), lines)
        last = _first_line(max(start_across, vertices_px[j, 1 - axis]), lines)
        edge_x, edge_y = vertices_px[j, 0] - vertices_px[i, 0], vertices_px[j, 1] - vertices_px[i, 1]
        apex_x, apex_y = vertices_px[k, 0] - vertices_px[i, 0], vertices_px[k, 1] - vertices_px[i, 1]
        slope = -edge_y if axis == 0 else edge_x
        outward = -1 if (edge_x * apex_y - edge_y * apex_x) * slope > 0.0 else 1
        # Row pairs and column pairs both meet a border: weights by the squared normal add up to one border.
        weight = slope * slope / (edge_x * edge_x + edge_y * edge_y) * np.float32(outward)
        inverse_start, inverse_end = one / depth_m[i], one / depth_m[j]
        for line in range(first, last):
            t = (np.float32(line) + half - start_across) / across
            position = start_along + t * along
            low = int(np.floor(min(max(position - half, np.float32(-2.0)), np.float32(size))))
            if not (low >= 0 and low < size - 1):
                continue
            inverse = inverse_start + t * (inverse_end - inverse_start)
            near, far = _pixels_of_crossing(face_id, depth, line, low, axis, outward, inverse)
            if near < 0:
                continue
            distance = (position - (np.float32(low + (outward < 0)) + half)) * np.float32(outward)
            pair = min(near, far)
            row = row_of_pair[pair]
            if row >= 0:
                if not distance > blends.distance[row]:
                    continue
                blends.distance[row] = -one
            row_of_pair[pair] = count
            blends.distance[count], blends.fraction[count] = distance, (distance - half) * abs(weight)
            blends.pixels[count, 0] = far if distance > half else near
            blends.pixels[count, 1], blends.pixels[count, 2] = near, far
            blends.ends[count, 0], blends.ends[count, 1] = i, j
            of_start, of_end = weight * (one - t), weight * t
            blends.derivatives[count, axis], blends.derivatives[count, 2 + axis] = of_start, of_end
            blends.derivatives[count, 1 - axis] = -of_start * along / across
            blends.derivatives[count, 3 - axis] = -of_end * along / across
            count += 1
    return count


@njit(**NJIT_OPTIONS)
def silhouette_blends_cpu(
    face_id: np.ndarray, depth: np.ndarray, vertices_px: np.ndarray, depth_m: np.ndarray, edges: np.ndarray
) -> tuple:
    """Return the blends of `reference.silhouette_blends` in its order, and their derivatives.

    Args:
        edges: vertices (s, 3) int64 (start, end, apex).

    Returns:
        pixels (n, 3) int64: target, near, far. fraction (n,). ends (n, 2) int64: start and end of the edge of each.
        derivatives (n, 4): of the fraction by x and y of start, and by x and y of end.
    """
    height, width = face_id.shape
    capacity = _count_crossings(vertices_px, edges, 0, height) + _count_crossings(vertices_px, edges, 1, width)
    pixels, ends = np.empty((capacity, 3), np.int64), np.empty((capacity, 2), np.int64)
    fraction, derivatives = np.empty(capacity, np.float32), np.empty((capacity, 4), np.float32)
    blends = BlendArrays(pixels, fraction, ends, derivatives, np.empty(capacity, np.float32))
    count = 0
    for axis in range(2):
        count = _add_along_axis(face_id, depth, vertices_px, depth_m, edges, axis, blends, count)
    kept = np.flatnonzero(blends.distance[:count] >= 0.0)
    return pixels[kept], fraction[kept], ends[kept], derivatives[kept]


@njit(**NJIT_OPTIONS)
def add_fraction_gradient(
    ends: np.ndarray, derivatives: np.ndarray, gradient: np.ndarray, vertex_count: int
) -> np.ndarray:
    """Return the gradient (v, 2) of the vertices from that (n,) of the fractions of `silhouette_blends_cpu`."""
    total = np.zeros((vertex_count, 2), np.float32)
    for row in range(gradient.shape[0]):
        i, j, g = ends[row, 0], ends[row, 1], gradient[row]
        total[i, 0] += g * derivatives[row, 0]
        total[i, 1] += g * derivatives[row, 1]
        total[j, 0] += g * derivatives[row, 2]
        total[j, 1] += g * derivatives[row, 3]
    return total
