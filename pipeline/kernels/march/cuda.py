"""CUDA kernels of ray marching: a thread samples a whole ray, then the samples are packed in order."""

import math
from typing import NamedTuple

import numpy as np
import torch
from numba import cuda
from torch import Tensor

from pipeline.kernels.common.cuda import CUDA_OPTIONS, device_function, launch
from pipeline.kernels.march.cpu import CANDIDATES, slab
from pipeline.kernels.march.inputs import Rays, SamplingVolume

_ZERO, _ONE = np.float32(0), np.float32(1)
_MAX_DISTANCE_M = np.float32(1e9)

_slab = device_function(slab)


class WarpTensors(NamedTuple):
    """See `pipeline.kernels.march.inputs.PackedWarpGrids`."""

    cell: np.float32
    origin: Tensor
    dims: Tensor
    offsets: Tensor
    canonical: Tensor
    cell_codes: Tensor
    affine_maps: Tensor


class OccupancyTensors(NamedTuple):
    """Occupancy grid (gx, gy, gz) uint8, its low corner (3, m), and the cells per metre along each axis (3)."""

    occupied: Tensor
    low: Tensor
    cells_per_m: Tensor


class SampleTensors(NamedTuple):
    """Canonical position (s, 3), distance along the ray (s) and ray (s, int32) of each sample."""

    canonical: Tensor
    distance: Tensor
    ray_indices: Tensor


@cuda.jit(device=True)
def _canonical(px, py, pz, cell, low, dims, first, code, candidate, warps):
    """Return the canonical position of a posed point: of the only inverse of its cell (code 0), or of a candidate.

    px, py, pz: position of the point in cells of the warp grid. cell: indices (3) of its cell.
    """
    i, j, k = cell
    gx, gy, gz = low
    _, ny, nz = dims
    node_first, map_first = first
    if code != 0:
        m, size, maps = map_first + (code - 1) // CANDIDATES + candidate, warps.cell, warps.affine_maps
        qx, qy, qz = px * size + gx, py * size + gy, pz * size + gz
        return (
            maps[m, 0] * qx + maps[m, 1] * qy + maps[m, 2] * qz + maps[m, 3],
            maps[m, 4] * qx + maps[m, 5] * qy + maps[m, 6] * qz + maps[m, 7],
            maps[m, 8] * qx + maps[m, 9] * qy + maps[m, 10] * qz + maps[m, 11],
        )
    nodes = warps.canonical
    u, v, w = px - np.float32(i), py - np.float32(j), pz - np.float32(k)
    x = y = z = _ZERO
    for corner in range(8):
        a, b, c = corner & 1, (corner >> 1) & 1, corner >> 2
        weight = (u if a else _ONE - u) * (v if b else _ONE - v) * (w if c else _ONE - w)
        node = node_first + ((i + a) * ny + j + b) * nz + k + c
        x += weight * nodes[node, 0]
        y += weight * nodes[node, 1]
        z += weight * nodes[node, 2]
    return x, y, z


@cuda.jit(**CUDA_OPTIONS)
def march_rays(rays, step, warps, occupancy, max_samples, slots, counts):
    """Fill the first counts[ray] of the `max_samples` slots of each ray."""
    ray = cuda.grid(1)
    if ray >= counts.shape[0]:
        return
    frame, jitter = rays.frame_index[ray], rays.jitter[ray]
    ox, oy, oz = rays.origins_m[ray, 0], rays.origins_m[ray, 1], rays.origins_m[ray, 2]
    dx, dy, dz = rays.directions[ray, 0], rays.directions[ray, 1], rays.directions[ray, 2]
    gx, gy, gz = warps.origin[frame, 0], warps.origin[frame, 1], warps.origin[frame, 2]
    nx, ny, nz = warps.dims[frame, 0], warps.dims[frame, 1], warps.dims[frame, 2]
    near, far = _slab(ox, dx, gx, gx + warps.cell * np.float32(nx - 1), _ZERO, _MAX_DISTANCE_M)
    near, far = _slab(oy, dy, gy, gy + warps.cell * np.float32(ny - 1), near, far)
    near, far = _slab(oz, dz, gz, gz + warps.cell * np.float32(nz - 1), near, far)
    # No plane ends a degenerate ray (NaN, or a zero direction): it would have 1e11 steps.
    steps = int(math.ceil((far - near) / step - jitter)) if far < _MAX_DISTANCE_M else 0
    node_first, code_first, map_first = warps.offsets[frame, 0], warps.offsets[frame, 1], warps.offsets[frame, 2]
    occupied, low, cells_per_m = occupancy.occupied, occupancy.low, occupancy.cells_per_m
    size_x, size_y, size_z = occupied.shape
    inverse, first, count = _ONE / warps.cell, ray * max_samples, 0
    for ray_step in range(steps):
        if count >= max_samples:
            break
        t = near + (np.float32(ray_step) + jitter) * step
        px, py, pz = (ox + t * dx - gx) * inverse, (oy + t * dy - gy) * inverse, (oz + t * dz - gz) * inverse
        i, j, k = min(max(int(px), 0), nx - 2), min(max(int(py), 0), ny - 2), min(max(int(pz), 0), nz - 2)
        code = warps.cell_codes[code_first + (i * (ny - 1) + j) * (nz - 1) + k]
        candidates = 0 if code < 0 else (1 if code == 0 else 1 + (code - 1) % CANDIDATES)
        for candidate in range(candidates):
            x, y, z = _canonical(
                px, py, pz, (i, j, k), (gx, gy, gz), (nx, ny, nz), (node_first, map_first), code, candidate, warps
            )
            cx, cy, cz = (x - low[0]) * cells_per_m[0], (y - low[1]) * cells_per_m[1], (z - low[2]) * cells_per_m[2]
            # False for NaN, too.
            inside_x, inside_y = _ZERO <= cx < np.float32(size_x), _ZERO <= cy < np.float32(size_y)
            inside = inside_x and inside_y and _ZERO <= cz < np.float32(size_z)
            if inside and count < max_samples and occupied[int(cx), int(cy), int(cz)] != 0:
                slot = first + count
                slots.canonical[slot, 0], slots.canonical[slot, 1], slots.canonical[slot, 2] = x, y, z
                slots.distance[slot] = t
                count += 1
    counts[ray] = count


@cuda.jit(**CUDA_OPTIONS)
def pack_samples(slots, ray_offsets, max_samples, samples):
    """Copy the samples out of the slots of their rays, one after the other; a thread for each slot."""
    slot = cuda.grid(1)
    if slot >= slots.distance.shape[0]:
        return
    ray, index = slot // max_samples, slot % max_samples
    target = ray_offsets[ray] + index
    if target < ray_offsets[ray + 1]:
        for axis in range(3):
            samples.canonical[target, axis] = slots.canonical[slot, axis]
        samples.distance[target] = slots.distance[slot]
        samples.ray_indices[target] = ray


def march(rays: Rays, volume: SamplingVolume, step_m: float, max_samples: int) -> tuple[SampleTensors, Tensor]:
    """Do `pipeline.kernels.march.march`; return the samples, as tensors, and the ray offsets."""
    device, count = rays.origins_m.device, len(rays.frame_index)
    low_m, high_m = volume.bounds_m
    cells_per_m = torch.tensor(volume.occupied.shape, device=device) / (high_m - low_m)
    occupancy = OccupancyTensors(volume.occupied, low_m.contiguous(), cells_per_m)
    warps = WarpTensors(np.float32(volume.warps.cell_m), *volume.warps.tensors())
    contiguous = Rays(*(tensor.contiguous() for tensor in rays))
    slots, counts = _samples(count * max_samples, device), torch.empty(count, dtype=torch.int64, device=device)
    launch(march_rays, count, contiguous, np.float32(step_m), warps, occupancy, max_samples, slots, counts)
    ray_offsets = torch.zeros(count + 1, dtype=torch.int64, device=device)
    torch.cumsum(counts, 0, out=ray_offsets[1:])
    samples = _samples(int(ray_offsets[-1]), device)
    launch(pack_samples, count * max_samples, slots, ray_offsets, max_samples, samples)
    return samples, ray_offsets


def _samples(count: int, device: torch.device) -> SampleTensors:
    """Return uninitialised memory for samples."""
    ray_indices = torch.empty(count, dtype=torch.int32, device=device)
    return SampleTensors(torch.empty(count, 3, device=device), torch.empty(count, device=device), ray_indices)
