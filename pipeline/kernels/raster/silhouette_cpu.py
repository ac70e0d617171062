"""Compiled loops of silhouette antialiasing; `pipeline.kernels.raster.reference` defines what they do.

Notation: an edge runs from start to end, its face lies on the side of the apex. Along an axis (0: x, 1: y), it crosses
lines of pixel centres; t is the fraction of the edge from start to end at a crossing, low the pixel before it.
"""

import numpy as np
from numba import njit

from pipeline.kernels.common.numba_options import NJIT_OPTIONS


@njit(**NJIT_OPTIONS)
def _first_line(across: float, lines: int) -> int:
    """Return the first line of pixel centres at or after a position, clamped to [0, lines]."""
    return int(np.ceil(min(max(across - np.float32(0.5), np.float32(0.0)), np.float32(lines))))


@njit(**NJIT_OPTIONS)
def _cross(ax: float, ay: float, bx: float, by: float) -> float:
    return ax * by - ay * bx


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
    half, one = np.float32(0.5), np.float32(1.0)
    capacity = 0
    for s in range(edges.shape[0]):
        for axis in range(2):
            start, end = vertices_px[edges[s, 0], 1 - axis], vertices_px[edges[s, 1], 1 - axis]
            lines = height if axis == 0 else width
            capacity += _first_line(max(start, end), lines) - _first_line(min(start, end), lines)
    pixels, fraction = np.empty((capacity, 3), np.int64), np.empty(capacity, np.float32)
    ends, derivatives = np.empty((capacity, 2), np.int64), np.empty((capacity, 4), np.float32)
    distances = np.empty(capacity, np.float32)
    row_of_pixel = np.empty(height * width, np.int64)
    count = 0
    for axis in range(2):
        row_of_pixel[:] = -1
        lines, size, step = (height, width, 1) if axis == 0 else (width, height, width)
        first_row = count
        for s in range(edges.shape[0]):
            i, j, k = edges[s, 0], edges[s, 1], edges[s, 2]
            if not (depth_m[i] > 0.0 and depth_m[j] > 0.0 and depth_m[k] > 0.0):
                continue
            start_along, start_across = vertices_px[i, axis], vertices_px[i, 1 - axis]
            end_along, end_across = vertices_px[j, axis], vertices_px[j, 1 - axis]
            first = _first_line(min(start_across, end_across), lines)
            last = _first_line(max(start_across, end_across), lines)
            if first >= last:
                continue
            edge_x, edge_y = vertices_px[j, 0] - vertices_px[i, 0], vertices_px[j, 1] - vertices_px[i, 1]
            apex_x, apex_y = vertices_px[k, 0] - vertices_px[i, 0], vertices_px[k, 1] - vertices_px[i, 1]
            slope = -edge_y if axis == 0 else edge_x
            outward = -1 if _cross(edge_x, edge_y, apex_x, apex_y) * slope > 0.0 else 1
            # Row pairs and column pairs both meet a border: weights by the squared normal add up to one border.
            weight = slope * slope / (edge_x * edge_x + edge_y * edge_y) * np.float32(outward)
            inverse_start, inverse_end = one / depth_m[i], one / depth_m[j]
            along, across = end_along - start_along, end_across - start_across
            for line in range(first, last):
                t = (np.float32(line) + half - start_across) / across
                position = start_along + t * along
                inverse = inverse_start + t * (inverse_end - inverse_start)
                low = int(np.floor(min(max(position - half, np.float32(-2.0)), np.float32(size))))
                if not (low >= 0 and low < size - 1):
                    continue
                low_pixel = line * width + low if axis == 0 else low * width + line
                near = low_pixel + (step if outward < 0 else 0)
                far = low_pixel + (step if outward > 0 else 0)
                near_y, near_x, far_y, far_x = near // width, near % width, far // width, far % width
                if not (
                    depth[near_y, near_x] < depth[far_y, far_x]
                    and depth[far_y, far_x] * inverse > 1.0
                    and face_id[near_y, near_x] != face_id[far_y, far_x]
                ):
                    continue
                near_position = np.float32(low + 1 if outward < 0 else low) + half
                distance = (position - near_position) * np.float32(outward)
                row = row_of_pixel[low_pixel]
                if row >= 0:
                    if not distance > distances[row]:
                        continue
                    distances[row] = np.float32(-1.0)  # superseded: dropped below
                row_of_pixel[low_pixel] = count
                distances[count] = distance
                moved = distance - half
                pixels[count, 0] = far if moved > 0.0 else near
                pixels[count, 1], pixels[count, 2] = near, far
                fraction[count] = moved * abs(weight)
                ends[count, 0], ends[count, 1] = i, j
                ratio = along / across
                derivatives[count, axis], derivatives[count, 1 - axis] = weight * (one - t), weight * ratio * (t - one)
                derivatives[count, 2 + axis], derivatives[count, 3 - axis] = weight * t, -weight * ratio * t
                count += 1
        kept = first_row
        for row in range(first_row, count):
            if distances[row] >= 0.0:
                pixels[kept], fraction[kept], ends[kept] = pixels[row], fraction[row], ends[row]
                derivatives[kept] = derivatives[row]
                kept += 1
        count = kept
    return pixels[:count].copy(), fraction[:count].copy(), ends[:count].copy(), derivatives[:count].copy()


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
