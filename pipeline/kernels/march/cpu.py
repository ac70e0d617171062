"""Compiled loops of ray marching: each thread samples whole rays, then the samples are packed in order."""

from typing import NamedTuple

import numpy as np
from numba import njit, prange

from pipeline.kernels.common.numba_options import NJIT_OPTIONS
from pipeline.kernels.inverse_skinning.newton_cpu import apply_affine

_ZERO, _ONE = np.float32(0), np.float32(1)
_MAX_DISTANCE_M = np.float32(1e9)
CANDIDATES = 4
"""Maximum number of inverses of one posed cell."""


class RayArrays(NamedTuple):
    """See `pipeline.kernels.march.inputs.Rays`."""

    origins: np.ndarray
    directions: np.ndarray
    frame_index: np.ndarray
    jitter: np.ndarray


class WarpArrays(NamedTuple):
    """See `pipeline.kernels.march.inputs.PackedWarpGrids`."""

    cell: np.float32
    origin: np.ndarray
    dims: np.ndarray
    offsets: np.ndarray
    canonical: np.ndarray
    cell_codes: np.ndarray
    affine_maps: np.ndarray


class OccupancyArrays(NamedTuple):
    """Occupancy grid (gx, gy, gz) uint8, its low corner (3, m), and the cells per metre along each axis (3)."""

    occupied: np.ndarray
    low: np.ndarray
    cells_per_m: np.ndarray


class MarchArrays(NamedTuple):
    """All inputs of ray marching; step in metres."""

    rays: RayArrays
    step: np.float32
    warps: WarpArrays
    occupancy: OccupancyArrays


class SampleArrays(NamedTuple):
    """Output: canonical position (s, 3), distance along the ray (s) and ray (s) of each sample."""

    canonical: np.ndarray
    distance: np.ndarray
    ray_indices: np.ndarray


@njit(**NJIT_OPTIONS)
def _slab(origin, direction, low, high, near, far):
    """Clip the interval [near, far] of a ray to the space between two planes of one axis."""
    if abs(direction) < np.float32(1e-9):
        return (near, far) if low <= origin <= high else (near, near - _ONE)
    a, b = (low - origin) / direction, (high - origin) / direction
    return max(near, min(a, b)), min(far, max(a, b))


@njit(**NJIT_OPTIONS)
def _is_occupied(x, y, z, occupancy):
    occupied, low, cells_per_m = occupancy
    i = int(np.floor((x - low[0]) * cells_per_m[0]))
    j = int(np.floor((y - low[1]) * cells_per_m[1]))
    k = int(np.floor((z - low[2]) * cells_per_m[2]))
    inside = 0 <= i < occupied.shape[0] and 0 <= j < occupied.shape[1] and 0 <= k < occupied.shape[2]
    return inside and occupied[i, j, k] != 0


@njit(**NJIT_OPTIONS)
def _interpolate(nodes, first, dims, cell, fractions):
    """Interpolate the canonical positions at the corners of a posed cell trilinearly."""
    i, j, k = cell
    u, v, w = fractions
    x = y = z = _ZERO
    for corner in range(8):
        a, b, c = corner & 1, (corner >> 1) & 1, corner >> 2
        weight = (u if a == 1 else _ONE - u) * (v if b == 1 else _ONE - v) * (w if c == 1 else _ONE - w)
        node = nodes[first + ((i + a) * dims[1] + j + b) * dims[2] + k + c]
        x, y, z = x + weight * node[0], y + weight * node[1], z + weight * node[2]
    return x, y, z


@njit(**NJIT_OPTIONS)
def intersect_box(ray, inputs):
    """Return the distance at which a ray enters the box of its warp grid, and its number of steps in the box."""
    rays, step, warps, _ = inputs
    frame = rays.frame_index[ray]
    low, dims = warps.origin[frame], warps.dims[frame]
    near, far = _ZERO, _MAX_DISTANCE_M
    for axis in range(3):
        high = low[axis] + warps.cell * np.float32(dims[axis] - 1)
        near, far = _slab(rays.origins[ray, axis], rays.directions[ray, axis], low[axis], high, near, far)
    # No plane ends a degenerate ray (NaN, or a zero direction): it would have 1e11 steps.
    return near, max(0, int(np.ceil((far - near) / step - rays.jitter[ray]))) if far < _MAX_DISTANCE_M else 0


@njit(**NJIT_OPTIONS)
def advance_ray(ray, steps, inputs, samples, count, target_count, max_count):
    """Append samples of a ray until there are `target_count` samples of all rays, but no more than `max_count`.

    steps: (distance of the box, index of the next step, number of steps). count: number of samples so far.
    Returns the number of samples and the index of the next step.
    """
    near, step_index, step_count = steps
    rays, step, warps, occupancy = inputs
    canonical, distance, ray_indices = samples
    f, jitter, cell, dims = rays.frame_index[ray], rays.jitter[ray], warps.cell, warps.dims[rays.frame_index[ray]]
    ox, oy, oz = rays.origins[ray, 0], rays.origins[ray, 1], rays.origins[ray, 2]
    dx, dy, dz = rays.directions[ray, 0], rays.directions[ray, 1], rays.directions[ray, 2]
    gx, gy, gz = warps.origin[f, 0], warps.origin[f, 1], warps.origin[f, 2]
    nx, ny, nz = dims[0], dims[1], dims[2]
    node_first, code_first, map_first = warps.offsets[f, 0], warps.offsets[f, 1], warps.offsets[f, 2]
    nodes, cell_codes, affine_maps = warps.canonical, warps.cell_codes, warps.affine_maps
    inverse = _ONE / cell
    while step_index < step_count and count < target_count:
        t = near + (np.float32(step_index) + jitter) * step
        step_index += 1
        px, py, pz = (ox + t * dx - gx) * inverse, (oy + t * dy - gy) * inverse, (oz + t * dz - gz) * inverse
        i, j, k = min(max(int(px), 0), nx - 2), min(max(int(py), 0), ny - 2), min(max(int(pz), 0), nz - 2)
        code = cell_codes[code_first + (i * (ny - 1) + j) * (nz - 1) + k]
        if code < 0:
            continue
        candidates = 1 if code == 0 else 1 + (code - 1) % CANDIDATES
        for candidate in range(candidates):
            if code == 0:
                u, v, w = px - np.float32(i), py - np.float32(j), pz - np.float32(k)
                x, y, z = _interpolate(nodes, node_first, dims, (i, j, k), (u, v, w))
            else:
                m = affine_maps[map_first + (code - 1) // CANDIDATES + candidate]
                x, y, z = apply_affine(m, px * cell + gx, py * cell + gy, pz * cell + gz)
            if count < max_count and _is_occupied(x, y, z, occupancy):
                canonical[count, 0], canonical[count, 1], canonical[count, 2] = x, y, z
                distance[count], ray_indices[count] = t, ray
                count += 1
    return count, step_index


@njit(parallel=True, **NJIT_OPTIONS)
def march(rays, step, warps, occupancy, max_samples):
    """Return canonical points (s, 3), distances (s) and ray offsets (n + 1) int64."""
    ray_count = rays.origins.shape[0]
    capacity = ray_count * max_samples
    canonical, distance = np.empty((capacity, 3), np.float32), np.empty(capacity, np.float32)
    samples = SampleArrays(canonical, distance, np.empty(capacity, np.int32))
    counts = np.zeros(ray_count, np.int64)
    for ray in prange(ray_count):
        first, inputs = ray * max_samples, MarchArrays(rays, step, warps, occupancy)
        near, step_count = intersect_box(ray, inputs)
        last, _ = advance_ray(
            ray, (near, 0, step_count), inputs, samples, first, first + max_samples, first + max_samples
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
