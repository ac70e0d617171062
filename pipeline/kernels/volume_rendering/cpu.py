"""Compiled loop of the fused renderer: march, Newton step, hash grid, network and compositing.

A block of rays advances a few samples at a time. These samples are evaluated together, and only rays that still have
transmittance continue. The working set stays in the cache, and samples behind a surface are never evaluated.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from pipeline.kernels.common.numba_options import NJIT_OPTIONS
from pipeline.kernels.hashgrid.cpu import BLOCK, HashTable, encode_block
from pipeline.kernels.inverse_skinning.cell_skinning_cpu import CellWeights, newton_steps
from pipeline.kernels.march.cpu import CANDIDATES, MarchArrays, RayProgress, SampleArrays, advance_rays, intersect_box

RAYS_PER_BLOCK = 128
"""Rays that advance together."""
SAMPLES_PER_PASS, HALF_TRANSMITTANCE = 3, np.float32(0.5)
"""Samples that each ray advances at a time; one at a time below this transmittance, where the next may be the last."""
MAX_SAMPLES_PER_PASS = RAYS_PER_BLOCK * (SAMPLES_PER_PASS + CANDIDATES)
_ZERO, _ONE = np.float32(0), np.float32(1)


class SkinningArrays(NamedTuple):
    """Frame of the batch of each ray (n), skin weights, and matrices (k, j, 16) of the frames; k = 0: no step."""

    batch_index: np.ndarray
    cells: CellWeights
    matrices: np.ndarray


class NetworkArrays(NamedTuple):
    """Weights (w, h) and (h, 4), bias (4); density is initial_density * exp(x), with |x| at most `exponent_limit`."""

    hidden: np.ndarray
    output: np.ndarray
    bias: np.ndarray
    initial_density: np.float32
    exponent_limit: np.float32


class FieldArrays(NamedTuple):
    """The radiance field in the box `bounds` (2, 3); `lanes` as in `pipeline.kernels.hashgrid.cpu`.

    gate: factors of the density, one for each voxel of the box (gx, gy, gz); empty: none.
    """

    bounds: np.ndarray
    table: HashTable
    lanes: tuple[int, ...]
    network: NetworkArrays
    gate: np.ndarray


class RenderArrays(NamedTuple):
    """All inputs of the renderer; `max_samples` for each ray."""

    march: MarchArrays
    skinning: SkinningArrays
    field: FieldArrays
    max_samples: int
    min_transmittance: np.float32


class SampleBuffers(NamedTuple):
    """Preallocated rows for samples: ray, canonical position, distance, inverse Jacobian (9), position in the unit box,
    features (w), colour (3), density, weight, and transmittance in front of the sample.
    """

    ray_indices: np.ndarray
    canonical: np.ndarray
    distance: np.ndarray
    inverse_jacobian: np.ndarray
    unit: np.ndarray
    features: np.ndarray
    colour: np.ndarray
    density: np.ndarray
    weight: np.ndarray
    transmittance: np.ndarray


class _DecodeBuffers(NamedTuple):
    """Features (w, BLOCK), activations (BLOCK) and network outputs (4, BLOCK) of a block of samples."""

    columns: np.ndarray
    layer: np.ndarray
    raw: np.ndarray


@njit(**NJIT_OPTIONS)
def _refine_samples(first, last, inputs, samples):
    """Do one Newton step for the samples first..last, if there are matrices; then map them to the unit box."""
    rays, bounds = inputs.march.rays, inputs.field.bounds
    batch_index, cells, matrices = inputs.skinning
    # Arrays are taken out of their tuples before the loop: in the loop this would count references for each sample.
    origins, directions, ray_indices, distance = rays.origins, rays.directions, samples.ray_indices, samples.distance
    canonical, unit = samples.canonical, samples.unit
    points = canonical
    if len(matrices):
        for s in range(first, last):
            ray, t = ray_indices[s], distance[s]
            unit[s, 0] = origins[ray, 0] + t * directions[ray, 0]
            unit[s, 1] = origins[ray, 1] + t * directions[ray, 1]
            unit[s, 2] = origins[ray, 2] + t * directions[ray, 2]
        newton_steps(first, last, ray_indices, batch_index, matrices, cells, canonical, unit, samples.inverse_jacobian)
        points = unit
    low_x, low_y, low_z = bounds[0, 0], bounds[0, 1], bounds[0, 2]
    scale_x, scale_y = _ONE / (bounds[1, 0] - low_x), _ONE / (bounds[1, 1] - low_y)
    scale_z = _ONE / (bounds[1, 2] - low_z)
    for s in range(first, last):
        x, y, z = points[s, 0], points[s, 1], points[s, 2]
        unit[s, 0], unit[s, 1], unit[s, 2] = (x - low_x) * scale_x, (y - low_y) * scale_y, (z - low_z) * scale_z


@njit(**NJIT_OPTIONS)
def _decode(first, last, network, samples, buffers):
    """Fill colour and density of the samples first..last, at most BLOCK, from their features."""
    hidden, output, bias, initial_density, exponent_limit = network
    features, colour, density = samples.features, samples.colour, samples.density
    columns, layer, raw = buffers
    size = last - first
    for i in range(hidden.shape[0]):
        for s in range(size):
            columns[i, s] = features[first + s, i]
    for c in range(4):
        for s in range(size):
            raw[c, s] = bias[c]
    for h in range(hidden.shape[1]):
        for s in range(size):
            layer[s] = _ZERO
        # Four inputs at a time, so that the sums are read and written less often; then the remaining inputs.
        whole = hidden.shape[0] // 4 * 4
        for i in range(0, whole, 4):
            w0, w1, w2, w3 = hidden[i, h], hidden[i + 1, h], hidden[i + 2, h], hidden[i + 3, h]
            for s in range(size):
                layer[s] += (w0 * columns[i, s] + w1 * columns[i + 1, s]) + (
                    w2 * columns[i + 2, s] + w3 * columns[i + 3, s]
                )
        for i in range(whole, hidden.shape[0]):
            for s in range(size):
                layer[s] += hidden[i, h] * columns[i, s]
        w0, w1, w2, w3 = output[h, 0], output[h, 1], output[h, 2], output[h, 3]
        for s in range(size):
            value = max(layer[s], _ZERO)
            raw[0, s] += value * w0
            raw[1, s] += value * w1
            raw[2, s] += value * w2
            raw[3, s] += value * w3
    for s in range(size):
        colour[first + s, 0] = _ONE / (_ONE + np.exp(-raw[0, s]))
        colour[first + s, 1] = _ONE / (_ONE + np.exp(-raw[1, s]))
        colour[first + s, 2] = _ONE / (_ONE + np.exp(-raw[2, s]))
        density[first + s] = initial_density * np.exp(min(max(raw[3, s], -exponent_limit), exponent_limit))


@njit(**NJIT_OPTIONS)
def _apply_gate(first, last, gate, samples):
    """Multiply the density of the samples first..last by the factor of their voxel."""
    unit, density = samples.unit, samples.density
    size_x, size_y, size_z = gate.shape
    for s in range(first, last):
        i = min(max(int(unit[s, 0] * np.float32(size_x)), 0), size_x - 1)
        j = min(max(int(unit[s, 1] * np.float32(size_y)), 0), size_y - 1)
        k = min(max(int(unit[s, 2] * np.float32(size_z)), 0), size_z - 1)
        density[s] *= gate[i, j, k]


@njit(**NJIT_OPTIONS)
def evaluate_field(first, last, field, samples):
    """Fill features, colour and density of the samples first..last at their positions in the unit box."""
    _, table, lanes, network, gate = field
    unit, features, levels = samples.unit, samples.features, table.level_params.shape[0]
    columns = np.empty((network.hidden.shape[0], BLOCK), np.float32)
    buffers = _DecodeBuffers(columns, np.empty(BLOCK, np.float32), np.empty((4, BLOCK), np.float32))
    for start in range(first, last, BLOCK):
        stop = min(start + BLOCK, last)
        for level in range(levels):
            encode_block(unit, table, lanes, level, features, start, stop)
        _decode(start, stop, network, samples, buffers)
        if gate.size:
            _apply_gate(start, stop, gate, samples)


@njit(**NJIT_OPTIONS)
def _composite(first, last, step, samples, image, transmittance):
    """Composite the samples first..last onto image (n, 3) and transmittance (n) of their rays."""
    ray_indices, density, colour, weight = samples.ray_indices, samples.density, samples.colour, samples.weight
    sample_transmittance = samples.transmittance
    for s in range(first, last):
        ray = ray_indices[s]
        segment_transmittance = np.exp(-density[s] * step)
        sample_transmittance[s] = transmittance[ray]
        weight[s] = transmittance[ray] * (_ONE - segment_transmittance)
        for channel in range(3):
            image[ray, channel] += weight[s] * colour[s, channel]
        transmittance[ray] *= segment_transmittance


@njit(**NJIT_OPTIONS)
def render_rays_fused(inputs, samples, capacity, image, transmittance):
    """Fill samples, image (n, 3) and final transmittance (n) of rays; image starts at 0, transmittance at 1.

    Returns the number of samples, or -1 if the first `capacity` rows of `samples` are too few.
    """
    rays, count, march, field = len(transmittance), 0, inputs.march, inputs.field
    marched = SampleArrays(samples.canonical, samples.distance, samples.ray_indices)
    near, step_count, step_index = np.empty(rays, np.float32), np.empty(rays, np.int64), np.zeros(rays, np.int64)
    samples_left = np.full(rays, inputs.max_samples)
    progress = RayProgress(near, step_count, step_index, samples_left)
    active_rays, target_counts = np.empty(RAYS_PER_BLOCK, np.int64), np.empty(RAYS_PER_BLOCK, np.int64)
    for block in range(0, rays, RAYS_PER_BLOCK):
        active_count = 0
        for ray in range(block, min(block + RAYS_PER_BLOCK, rays)):
            near[ray], step_count[ray] = intersect_box(ray, march)
            if step_count[ray] > 0:
                active_rays[active_count] = ray
                active_count += 1
        while active_count:
            first = count
            if first + MAX_SAMPLES_PER_PASS > capacity:
                return -1
            for index in range(active_count):
                is_half_lit = transmittance[active_rays[index]] >= HALF_TRANSMITTANCE
                target_counts[index] = SAMPLES_PER_PASS if is_half_lit else 1
            count = advance_rays(active_rays[:active_count], progress, target_counts, march, marched, count)
            _refine_samples(first, count, inputs, samples)
            evaluate_field(first, count, field, samples)
            _composite(first, count, march.step, samples, image, transmittance)
            still_active = 0
            for index in range(active_count):
                ray = active_rays[index]
                has_steps = step_index[ray] < step_count[ray] and samples_left[ray] > 0
                if has_steps and transmittance[ray] >= inputs.min_transmittance:
                    active_rays[still_active] = ray
                    still_active += 1
            active_count = still_active
    return count
