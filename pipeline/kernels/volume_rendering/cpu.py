"""Compiled loop that follows rays until no light is left: march, Newton, hash grid, network, compositing in one.

A few rays go a few samples ahead, these are shaded together, and the rays that have light left go on. What is worked
at stays in the cache; what lies behind a surface is never asked.
"""

import numpy as np
from numba import njit

from pipeline.kernels.common.numba_options import NJIT_OPTIONS
from pipeline.kernels.hashgrid.cpu import BLOCK, encode_block
from pipeline.kernels.inverse_skinning.newton_cpu import newton_step
from pipeline.kernels.march.cpu import CANDIDATES, advance_ray, intersect_box

RAYS_PER_BLOCK, SAMPLES_PER_PASS, HALF_TRANSMITTANCE = 128, 3, np.float32(0.5)
"""Rays that are followed together, and samples that each goes ahead: one by one with less than DIM of its light left,
where the next may be the last.
"""
MAX_SAMPLES_PER_PASS = RAYS_PER_BLOCK * (SAMPLES_PER_PASS + CANDIDATES)
_ZERO, _ONE = np.float32(0), np.float32(1)


@njit(**NJIT_OPTIONS)
def _refine_samples(
    first, last, canonical, distance, ray_indices, origins, directions, batch_index, skin_origin, skin_cell,
    row_of_node, blended,
    bounds, unit, inverse_jacobian,
):  # fmt: skip
    """One Newton step of samples (`pipeline.kernels.inverse_skinning.newton`), if any; then into the unit box."""
    low_x, low_y, low_z = bounds[0, 0], bounds[0, 1], bounds[0, 2]
    scale_x, scale_y = _ONE / (bounds[1, 0] - low_x), _ONE / (bounds[1, 1] - low_y)
    scale_z = _ONE / (bounds[1, 2] - low_z)
    for s in range(first, last):
        x, y, z = canonical[s, 0], canonical[s, 1], canonical[s, 2]
        if len(blended):
            ray, t = ray_indices[s], distance[s]
            px, py, pz = (
                origins[ray, 0] + t * directions[ray, 0],
                origins[ray, 1] + t * directions[ray, 1],
                origins[ray, 2] + t * directions[ray, 2],
            )
            x, y, z = newton_step(
                px, py, pz, x, y, z, batch_index[ray], skin_origin, skin_cell, row_of_node, blended, inverse_jacobian[s]
            )
        unit[s, 0], unit[s, 1], unit[s, 2] = (x - low_x) * scale_x, (y - low_y) * scale_y, (z - low_z) * scale_z


@njit(**NJIT_OPTIONS)
def _decode(
    first, last, features, hidden, output, bias, initial_density, exponent_limit, colour, density, columns, layer, raw
):
    """Colour and density of at most BLOCK samples. columns (w, BLOCK), layer (BLOCK), raw (4, BLOCK): scratch."""
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
        # Four at once: the sums are read and written less often. The width is a multiple of four, or the rest follows.
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
def evaluate_field(
    first,
    last,
    unit,
    table,
    level_params,
    hidden,
    output,
    bias,
    initial_density,
    exponent_limit,
    features,
    colour,
    density,
    lanes,
):
    """Fill features, colour and density of the samples first..last at points of the unit box."""
    columns, layer = np.empty((hidden.shape[0], BLOCK), np.float32), np.empty(BLOCK, np.float32)
    raw = np.empty((4, BLOCK), np.float32)
    for start in range(first, last, BLOCK):
        stop = min(start + BLOCK, last)
        for level in range(level_params.shape[0]):
            encode_block(unit, table, level_params, level, features, start, stop, lanes)
        _decode(
            start,
            stop,
            features,
            hidden,
            output,
            bias,
            initial_density,
            exponent_limit,
            colour,
            density,
            columns,
            layer,
            raw,
        )


@njit(**NJIT_OPTIONS)
def _composite(first, last, ray_indices, density, colour, step, transmittance, weight, sample_transmittance, image):
    for s in range(first, last):
        ray = ray_indices[s]
        segment_transmittance = np.exp(-density[s] * step)
        sample_transmittance[s] = transmittance[ray]
        weight[s] = transmittance[ray] * (_ONE - segment_transmittance)
        for channel in range(3):
            image[ray, channel] += weight[s] * colour[s, channel]
        transmittance[ray] *= segment_transmittance


@njit(**NJIT_OPTIONS)
def trace(
    origins, directions, frame, batch_index, jitter, step, max_samples, min_transmittance,
    cell, warp_origin, warp_dims, warp_first, warp_nodes, warp_codes, warp_maps, occupied, low, scale,
    skin_origin, skin_cell, row_of_node, blended,
    bounds, table, level_params, hidden, output, bias, initial_density, exponent_limit, lanes,
    image, transmittance, capacity, ray_indices, canonical, distance, inverse_jacobian, unit, features, colour,
    density, weight, sample_transmittance,
):  # fmt: skip
    """The number of samples, -1 if there was no room for them; fills all that follow `lanes`: see
    `pipeline.kernels.volume_rendering.trace`.
    """
    rays, count = len(origins), 0
    near, step_count, stop = np.empty(rays, np.float32), np.empty(rays, np.int64), np.zeros(rays, np.int64)
    samples_left, active_rays = np.full(rays, max_samples), np.empty(RAYS_PER_BLOCK, np.int64)
    for block in range(0, rays, RAYS_PER_BLOCK):
        active_count = 0
        for ray in range(block, min(block + RAYS_PER_BLOCK, rays)):
            f = frame[ray]
            near[ray], step_count[ray] = intersect_box(
                ray, origins, directions, jitter, step, cell, warp_origin[f], warp_dims[f]
            )
            if step_count[ray] > 0:
                active_rays[active_count] = ray
                active_count += 1
        while active_count:
            first = count
            if first + MAX_SAMPLES_PER_PASS > capacity:
                return -1
            for place in range(active_count):
                ray, previous_count = active_rays[place], count
                pass_samples = SAMPLES_PER_PASS if transmittance[ray] >= HALF_TRANSMITTANCE else 1
                count, stop[ray] = advance_ray(
                    ray, near[ray], stop[ray], step_count[ray], count + pass_samples, count + samples_left[ray],
                    origins, directions, jitter, step, cell, frame[ray],
                    warp_origin, warp_dims, warp_first, warp_nodes, warp_codes, warp_maps,
                    occupied, low, scale, count, canonical, distance, ray_indices,
                )  # fmt: skip
                samples_left[ray] -= count - previous_count
            _refine_samples(
                first, count, canonical, distance, ray_indices, origins, directions, batch_index,
                skin_origin, skin_cell, row_of_node, blended, bounds, unit, inverse_jacobian,
            )  # fmt: skip
            evaluate_field(
                first, count, unit, table, level_params, hidden, output, bias, initial_density, exponent_limit,
                features, colour, density, lanes,
            )  # fmt: skip
            _composite(
                first, count, ray_indices, density, colour, step, transmittance, weight, sample_transmittance, image
            )
            still_active = 0
            for place in range(active_count):
                ray = active_rays[place]
                if stop[ray] < step_count[ray] and samples_left[ray] > 0 and transmittance[ray] >= min_transmittance:
                    active_rays[still_active] = ray
                    still_active += 1
            active_count = still_active
    return count
