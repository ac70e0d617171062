"""Compiled loops of ray marching: a thread takes whole rays, then the rays are packed in order."""

import numpy as np
from numba import njit, prange

from pipeline.kernels.options import OPTIONS
from pipeline.kernels.warp_cpu import apply_affine

_ZERO, _ONE = np.float32(0), np.float32(1)
_ENDLESS_M = np.float32(1e9)


@njit(**OPTIONS)
def _slab(origin, direction, low, high, near, far):
    """Narrow [near, far] to the part of a ray between two planes of one axis."""
    if abs(direction) < np.float32(1e-9):
        return (near, far) if low <= origin <= high else (near, near - _ONE)
    a, b = (low - origin) / direction, (high - origin) / direction
    return max(near, min(a, b)), min(far, max(a, b))


@njit(**OPTIONS)
def _is_occupied(x, y, z, occupied, low, scale):
    i = int(np.floor((x - low[0]) * scale[0]))
    j = int(np.floor((y - low[1]) * scale[1]))
    k = int(np.floor((z - low[2]) * scale[2]))
    inside = 0 <= i < occupied.shape[0] and 0 <= j < occupied.shape[1] and 0 <= k < occupied.shape[2]
    return inside and occupied[i, j, k] != 0


@njit(**OPTIONS)
def _interpolate(nodes, first, dims, i, j, k, u, v, w):
    """Trilinear interpolation of the canonical positions at a posed cell's corners."""
    x = y = z = _ZERO
    for corner in range(8):
        a, b, c = corner & 1, (corner >> 1) & 1, corner >> 2
        weight = (u if a == 1 else _ONE - u) * (v if b == 1 else _ONE - v) * (w if c == 1 else _ONE - w)
        node = nodes[first + ((i + a) * dims[1] + j + b) * dims[2] + k + c]
        x, y, z = x + weight * node[0], y + weight * node[1], z + weight * node[2]
    return x, y, z


@njit(parallel=True, **OPTIONS)
def march(
    origins,
    directions,
    frame,
    jitter,
    step,
    cell,
    warp_origin,
    warp_dims,
    warp_first,
    warp_nodes,
    warp_codes,
    warp_maps,
    occupied,
    bounds,
    max_samples,
):
    """(canonical points (s, 3), distances (s), ray starts (n + 1) int64): see `pipeline.kernels.march.march`."""
    rays = origins.shape[0]
    found = np.empty((rays, max_samples, 4), np.float32)
    counts = np.zeros(rays, np.int64)
    low, scale = bounds[0], np.empty(3, np.float32)
    for axis in range(3):
        scale[axis] = np.float32(occupied.shape[axis]) / (bounds[1, axis] - bounds[0, axis])
    inverse = _ONE / cell
    for ray in prange(rays):
        f = frame[ray]
        origin, dims = warp_origin[f], warp_dims[f]
        near, far = _ZERO, _ENDLESS_M
        for axis in range(3):
            high = origin[axis] + cell * np.float32(dims[axis] - 1)
            near, far = _slab(origins[ray, axis], directions[ray, axis], origin[axis], high, near, far)
        # A ray that no plane ends is no ray (NaN, or a direction of zeros): it would make 1e11 stops.
        stops = max(0, int(np.ceil((far - near) / step - jitter[ray]))) if far < _ENDLESS_M else 0
        count = 0
        for stop in range(stops):
            t = near + (np.float32(stop) + jitter[ray]) * step
            px = (origins[ray, 0] + t * directions[ray, 0] - origin[0]) * inverse
            py = (origins[ray, 1] + t * directions[ray, 1] - origin[1]) * inverse
            pz = (origins[ray, 2] + t * directions[ray, 2] - origin[2]) * inverse
            i = min(max(int(px), 0), dims[0] - 2)
            j = min(max(int(py), 0), dims[1] - 2)
            k = min(max(int(pz), 0), dims[2] - 2)
            code = warp_codes[warp_first[f, 1] + (i * (dims[1] - 1) + j) * (dims[2] - 1) + k]
            if code == -1:
                continue
            candidates = 1 if code == 0 else 1 + (code - 1) % 4
            for candidate in range(candidates):
                if code == 0:
                    u, v, w = px - np.float32(i), py - np.float32(j), pz - np.float32(k)
                    x, y, z = _interpolate(warp_nodes, warp_first[f, 0], dims, i, j, k, u, v, w)
                else:
                    m = warp_maps[warp_first[f, 2] + (code - 1) // 4 + candidate]
                    qx, qy, qz = px * cell + origin[0], py * cell + origin[1], pz * cell + origin[2]
                    x, y, z = apply_affine(m, qx, qy, qz)
                if count < max_samples and _is_occupied(x, y, z, occupied, low, scale):
                    found[ray, count, 0], found[ray, count, 1] = x, y
                    found[ray, count, 2], found[ray, count, 3] = z, t
                    count += 1
        counts[ray] = count
    return _pack(found, counts)


@njit(parallel=True, **OPTIONS)
def _pack(found, counts):
    rays = counts.shape[0]
    ray_start = np.zeros(rays + 1, np.int64)
    for ray in range(rays):
        ray_start[ray + 1] = ray_start[ray] + counts[ray]
    points = np.empty((ray_start[rays], 3), np.float32)
    distance = np.empty(ray_start[rays], np.float32)
    for ray in prange(rays):
        first = ray_start[ray]
        for index in range(counts[ray]):
            points[first + index, 0] = found[ray, index, 0]
            points[first + index, 1] = found[ray, index, 1]
            points[first + index, 2] = found[ray, index, 2]
            distance[first + index] = found[ray, index, 3]
    return points, distance, ray_start
