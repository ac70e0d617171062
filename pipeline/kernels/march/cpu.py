"""Compiled loops of ray marching: a thread takes whole rays, then the rays are packed in order."""

import numpy as np
from numba import njit, prange

from pipeline.kernels.common.numba_options import NJIT_OPTIONS
from pipeline.kernels.inverse_skinning.newton_cpu import apply_affine

_ZERO, _ONE = np.float32(0), np.float32(1)
_MAX_DISTANCE_M = np.float32(1e9)
CANDIDATES = 4
"""Inverses that a stop has at most."""


@njit(**NJIT_OPTIONS)
def _slab(origin, direction, low, high, near, far):
    """Narrow [near, far] to the part of a ray between two planes of one axis."""
    if abs(direction) < np.float32(1e-9):
        return (near, far) if low <= origin <= high else (near, near - _ONE)
    a, b = (low - origin) / direction, (high - origin) / direction
    return max(near, min(a, b)), min(far, max(a, b))


@njit(**NJIT_OPTIONS)
def _is_occupied(x, y, z, occupied, low, scale):
    i = int(np.floor((x - low[0]) * scale[0]))
    j = int(np.floor((y - low[1]) * scale[1]))
    k = int(np.floor((z - low[2]) * scale[2]))
    inside = 0 <= i < occupied.shape[0] and 0 <= j < occupied.shape[1] and 0 <= k < occupied.shape[2]
    return inside and occupied[i, j, k] != 0


@njit(**NJIT_OPTIONS)
def _interpolate(nodes, first, dims, i, j, k, u, v, w):
    """Trilinear interpolation of the canonical positions at a posed cell's corners."""
    x = y = z = _ZERO
    for corner in range(8):
        a, b, c = corner & 1, (corner >> 1) & 1, corner >> 2
        weight = (u if a == 1 else _ONE - u) * (v if b == 1 else _ONE - v) * (w if c == 1 else _ONE - w)
        node = nodes[first + ((i + a) * dims[1] + j + b) * dims[2] + k + c]
        x, y, z = x + weight * node[0], y + weight * node[1], z + weight * node[2]
    return x, y, z


@njit(**NJIT_OPTIONS)
def intersect_box(ray, origins, directions, jitter, step, cell, low, dims):
    """Where a ray enters the box of a warp grid, and how many stops it makes there."""
    near, far = _ZERO, _MAX_DISTANCE_M
    for axis in range(3):
        high = low[axis] + cell * np.float32(dims[axis] - 1)
        near, far = _slab(origins[ray, axis], directions[ray, axis], low[axis], high, near, far)
    # A ray that no plane ends is no ray (NaN, or a direction of zeros): it would make 1e11 stops.
    return near, max(0, int(np.ceil((far - near) / step - jitter[ray]))) if far < _MAX_DISTANCE_M else 0


@njit(**NJIT_OPTIONS)
def advance_ray(
    ray,
    near,
    step_index,
    step_count,
    target_count,
    max_count,
    origins,
    directions,
    jitter,
    step,
    cell,
    f,
    warp_origin,
    warp_dims,
    warp_first,
    warp_nodes,
    warp_codes,
    warp_maps,
    occupied,
    low,
    scale,
    count,
    canonical,
    distance,
    ray_indices,
):
    """Note samples of a ray until there are `target_count` of all rays; none once there are `max_count`: (samples,
    next stop).
    """
    ox, oy, oz = origins[ray, 0], origins[ray, 1], origins[ray, 2]
    dx, dy, dz = directions[ray, 0], directions[ray, 1], directions[ray, 2]
    gx, gy, gz = warp_origin[f, 0], warp_origin[f, 1], warp_origin[f, 2]
    nx, ny, nz = warp_dims[f, 0], warp_dims[f, 1], warp_dims[f, 2]
    dims = warp_dims[f]
    node_first, code_first, map_first = warp_first[f, 0], warp_first[f, 1], warp_first[f, 2]
    inverse = _ONE / cell
    while step_index < step_count and count < target_count:
        t = near + (np.float32(step_index) + jitter[ray]) * step
        step_index += 1
        px, py, pz = (ox + t * dx - gx) * inverse, (oy + t * dy - gy) * inverse, (oz + t * dz - gz) * inverse
        i, j, k = min(max(int(px), 0), nx - 2), min(max(int(py), 0), ny - 2), min(max(int(pz), 0), nz - 2)
        code = warp_codes[code_first + (i * (ny - 1) + j) * (nz - 1) + k]
        if code < 0:
            continue
        candidates = 1 if code == 0 else 1 + (code - 1) % CANDIDATES
        for candidate in range(candidates):
            if code == 0:
                u, v, w = px - np.float32(i), py - np.float32(j), pz - np.float32(k)
                x, y, z = _interpolate(warp_nodes, node_first, dims, i, j, k, u, v, w)
            else:
                m = warp_maps[map_first + (code - 1) // CANDIDATES + candidate]
                x, y, z = apply_affine(m, px * cell + gx, py * cell + gy, pz * cell + gz)
            if count < max_count and _is_occupied(x, y, z, occupied, low, scale):
                canonical[count, 0], canonical[count, 1], canonical[count, 2] = x, y, z
                distance[count], ray_indices[count] = t, ray
                count += 1
    return count, step_index


@njit(parallel=True, **NJIT_OPTIONS)
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
    canonical, distance = np.empty((rays * max_samples, 3), np.float32), np.empty(rays * max_samples, np.float32)
    ray_indices, counts = np.empty(rays * max_samples, np.int32), np.zeros(rays, np.int64)
    low, scale = bounds[0], np.empty(3, np.float32)
    for axis in range(3):
        scale[axis] = np.float32(occupied.shape[axis]) / (bounds[1, axis] - bounds[0, axis])
    for ray in prange(rays):
        f, first = frame[ray], ray * max_samples
        near, step_count = intersect_box(ray, origins, directions, jitter, step, cell, warp_origin[f], warp_dims[f])
        last, _ = advance_ray(
            ray,
            near,
            0,
            step_count,
            first + max_samples,
            first + max_samples,
            origins,
            directions,
            jitter,
            step,
            cell,
            f,
            warp_origin,
            warp_dims,
            warp_first,
            warp_nodes,
            warp_codes,
            warp_maps,
            occupied,
            low,
            scale,
            first,
            canonical,
            distance,
            ray_indices,
        )
        counts[ray] = last - first
    return _pack(canonical, distance, counts, max_samples)


@njit(parallel=True, **NJIT_OPTIONS)
def _pack(canonical, distances, counts, max_samples):
    rays = counts.shape[0]
    ray_offsets = np.zeros(rays + 1, np.int64)
    for ray in range(rays):
        ray_offsets[ray + 1] = ray_offsets[ray] + counts[ray]
    points = np.empty((ray_offsets[rays], 3), np.float32)
    distance = np.empty(ray_offsets[rays], np.float32)
    for ray in prange(rays):
        for index in range(counts[ray]):
            target, source = ray_offsets[ray] + index, ray * max_samples + index
            points[target, 0], points[target, 1], points[target, 2] = (
                canonical[source, 0],
                canonical[source, 1],
                canonical[source, 2],
            )
            distance[target] = distances[source]
    return points, distance, ray_offsets
