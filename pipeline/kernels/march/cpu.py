"""Compiled loops of ray marching: each thread samples whole rays, then the samples are packed in order."""

from typing import NamedTuple

import numpy as np
from numba import njit, prange

from pipeline.kernels.common.numba_options import NJIT_OPTIONS

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


class RayProgress(NamedTuple):
    """State of all rays (n): distance of the box, steps in it, next step, samples that are still allowed."""

    near: np.ndarray
    step_count: np.ndarray
    step_index: np.ndarray
    samples_left: np.ndarray


@njit(**NJIT_OPTIONS)
def slab(origin, direction, low, high, near, far):
    """Clip the interval [near, far] of a ray to the space between two planes of one axis."""
    if abs(direction) < np.float32(1e-9):
        return (near, far) if low <= origin <= high else (near, near - _ONE)
    a, b = (low - origin) / direction, (high - origin) / direction
    return max(near, min(a, b)), min(far, max(a, b))


@njit(**NJIT_OPTIONS)
def intersect_box(ray, inputs):
    """Return the distance at which a ray enters the box of its warp grid, and its number of steps in the box."""
    rays, step, warps, _ = inputs
    frame = rays.frame_index[ray]
    low, dims = warps.origin[frame], warps.dims[frame]
    near, far = _ZERO, _MAX_DISTANCE_M
    for axis in range(3):
        high = low[axis] + warps.cell * np.float32(dims[axis] - 1)
        near, far = slab(rays.origins[ray, axis], rays.directions[ray, axis], low[axis], high, near, far)
    # No plane ends a degenerate ray (NaN, or a zero direction): it would have 1e11 steps.
    return near, max(0, int(np.ceil((far - near) / step - rays.jitter[ray]))) if far < _MAX_DISTANCE_M else 0


@njit(**NJIT_OPTIONS)
def advance_rays(active, progress, target_counts, inputs, samples, count):
    """Append samples of the rays `active`, of each at least `target_counts` if it has them; return their number.

    A posed cell with several inverses may add more, up to the samples that the ray has left. count: samples so far.
    """
    near, step_count, step_index, samples_left = progress
    rays, step, warps, occupancy = inputs
    canonical, distance, ray_indices = samples
    # Arrays are taken out of their tuples, and the inner loop calls nothing: a call passes ten numbers for each array.
    origins, directions, frame_index, jitters = rays
    cell, box_low, box_dims, offsets, nodes, cell_codes, affine_maps = warps
    occupied, low, cells_per_m = occupancy
    low_x, low_y, low_z = low[0], low[1], low[2]
    scale_x, scale_y, scale_z = cells_per_m[0], cells_per_m[1], cells_per_m[2]
    size_x, size_y, size_z = occupied.shape
    limit_x, limit_y, limit_z = np.float32(size_x), np.float32(size_y), np.float32(size_z)
    inverse, one = _ONE / cell, np.uint64(1)
    for index in range(len(active)):
        ray = active[index]
        f, jitter, ray_near, last_step = frame_index[ray], jitters[ray], near[ray], step_count[ray]
        first, target_count, max_count = count, count + target_counts[index], count + samples_left[ray]
        ox, oy, oz = origins[ray, 0], origins[ray, 1], origins[ray, 2]
        dx, dy, dz = directions[ray, 0], directions[ray, 1], directions[ray, 2]
        gx, gy, gz = box_low[f, 0], box_low[f, 1], box_low[f, 2]
        nx, ny, nz = box_dims[f, 0], box_dims[f, 1], box_dims[f, 2]
        node_first, code_first, map_first = offsets[f, 0], offsets[f, 1], offsets[f, 2]
        ray_step = step_index[ray]
        while ray_step < last_step and count < target_count:
            t = ray_near + (np.float32(ray_step) + jitter) * step
            ray_step += 1
            px, py, pz = (ox + t * dx - gx) * inverse, (oy + t * dy - gy) * inverse, (oz + t * dz - gz) * inverse
            i, j, k = min(max(int(px), 0), nx - 2), min(max(int(py), 0), ny - 2), min(max(int(pz), 0), nz - 2)
            code = cell_codes[np.uint64(code_first + (i * (ny - 1) + j) * (nz - 1) + k)]
            if code < 0:
                continue
            candidates = 1 if code == 0 else 1 + (code - 1) % CANDIDATES
            for candidate in range(candidates):
                if code == 0:
                    u, v, w = px - np.float32(i), py - np.float32(j), pz - np.float32(k)
                    # Trilinear, along z first: the two nodes are neighbours in memory.
                    # Unsigned, so that no index is tested for being negative.
                    n00 = np.uint64(node_first + (i * ny + j) * nz + k)
                    n01, n10 = n00 + np.uint64(nz), n00 + np.uint64(ny * nz)
                    n11 = n10 + np.uint64(nz)
                    a, b, c, d = nodes[n00, 0], nodes[n01, 0], nodes[n10, 0], nodes[n11, 0]
                    a, b = a + w * (nodes[n00 + one, 0] - a), b + w * (nodes[n01 + one, 0] - b)
                    c, d = c + w * (nodes[n10 + one, 0] - c), d + w * (nodes[n11 + one, 0] - d)
                    a, c = a + v * (b - a), c + v * (d - c)
                    x = a + u * (c - a)
                    a, b, c, d = nodes[n00, 1], nodes[n01, 1], nodes[n10, 1], nodes[n11, 1]
                    a, b = a + w * (nodes[n00 + one, 1] - a), b + w * (nodes[n01 + one, 1] - b)
                    c, d = c + w * (nodes[n10 + one, 1] - c), d + w * (nodes[n11 + one, 1] - d)
                    a, c = a + v * (b - a), c + v * (d - c)
                    y = a + u * (c - a)
                    a, b, c, d = nodes[n00, 2], nodes[n01, 2], nodes[n10, 2], nodes[n11, 2]
                    a, b = a + w * (nodes[n00 + one, 2] - a), b + w * (nodes[n01 + one, 2] - b)
                    c, d = c + w * (nodes[n10 + one, 2] - c), d + w * (nodes[n11 + one, 2] - d)
                    a, c = a + v * (b - a), c + v * (d - c)
                    z = a + u * (c - a)
                else:
                    m = map_first + (code - 1) // CANDIDATES + candidate
                    qx, qy, qz = px * cell + gx, py * cell + gy, pz * cell + gz
                    x = affine_maps[m, 0] * qx + affine_maps[m, 1] * qy + affine_maps[m, 2] * qz + affine_maps[m, 3]
                    y = affine_maps[m, 4] * qx + affine_maps[m, 5] * qy + affine_maps[m, 6] * qz + affine_maps[m, 7]
                    z = affine_maps[m, 8] * qx + affine_maps[m, 9] * qy + affine_maps[m, 10] * qz + affine_maps[m, 11]
                cx, cy, cz = (x - low_x) * scale_x, (y - low_y) * scale_y, (z - low_z) * scale_z
                # False for NaN, too.
                inside = _ZERO <= cx < limit_x and _ZERO <= cy < limit_y and _ZERO <= cz < limit_z
                if inside and count < max_count and occupied[int(cx), int(cy), int(cz)] != 0:
                    canonical[count, 0], canonical[count, 1], canonical[count, 2] = x, y, z
                    distance[count], ray_indices[count] = t, ray
                    count += 1
        step_index[ray] = ray_step
        samples_left[ray] -= count - first
    return count


@njit(parallel=True, **NJIT_OPTIONS)
def march(rays, step, warps, occupancy, max_samples):
    """Return canonical points (s, 3), distances (s) and ray offsets (n + 1) int64."""
    ray_count = rays.origins.shape[0]
    capacity = ray_count * max_samples
    canonical, distance = np.empty((capacity, 3), np.float32), np.empty(capacity, np.float32)
    ray_indices, counts = np.empty(capacity, np.int32), np.zeros(ray_count, np.int64)
    near, step_count = np.empty(ray_count, np.float32), np.empty(ray_count, np.int64)
    step_index, samples_left = np.zeros(ray_count, np.int64), np.full(ray_count, max_samples)
    all_rays, target_counts = np.arange(ray_count), np.full(1, max_samples)
    for ray in prange(ray_count):
        first, inputs = ray * max_samples, MarchArrays(rays, step, warps, occupancy)
        near[ray], step_count[ray] = intersect_box(ray, inputs)
        progress = RayProgress(near, step_count, step_index, samples_left)
        samples = SampleArrays(canonical, distance, ray_indices)
        last = advance_rays(all_rays[ray : ray + 1], progress, target_counts, inputs, samples, first)
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
