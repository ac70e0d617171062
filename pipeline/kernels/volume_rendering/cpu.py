"""Compiled loop that follows rays until no light is left: march, Newton, hash grid, network, compositing in one.

A few rays go a few samples ahead, these are shaded together, and the rays that have light left go on. What is worked
at stays in the cache; what lies behind a surface is never asked.
"""

import numpy as np
from numba import njit

from pipeline.kernels.common.numba_options import OPTIONS
from pipeline.kernels.hashgrid.cpu import BLOCK, encode_block
from pipeline.kernels.inverse_skinning.newton_cpu import newton_step
from pipeline.kernels.march.cpu import CANDIDATES, enter, go_on

RAYS, AHEAD, DIM = 128, 3, np.float32(0.5)
"""Rays that are followed together, and samples that each goes ahead: one by one with less than DIM of its light left,
where the next may be the last.
"""
MOST_AT_ONCE = RAYS * (AHEAD + CANDIDATES)
_ZERO, _ONE = np.float32(0), np.float32(1)


@njit(**OPTIONS)
def _refine(
    first, last, found, distance, owner, origins, directions, slot, skin_origin, skin_cell, row_of_node, blended,
    bounds, unit, inverse_jacobian,
):  # fmt: skip
    """One Newton step of samples (`pipeline.kernels.inverse_skinning.newton`), if any; then into the unit box."""
    low_x, low_y, low_z = bounds[0, 0], bounds[0, 1], bounds[0, 2]
    scale_x, scale_y = _ONE / (bounds[1, 0] - low_x), _ONE / (bounds[1, 1] - low_y)
    scale_z = _ONE / (bounds[1, 2] - low_z)
    for s in range(first, last):
        x, y, z = found[s, 0], found[s, 1], found[s, 2]
        if len(blended):
            ray, t = owner[s], distance[s]
            px, py, pz = (
                origins[ray, 0] + t * directions[ray, 0],
                origins[ray, 1] + t * directions[ray, 1],
                origins[ray, 2] + t * directions[ray, 2],
            )
            x, y, z = newton_step(
                px, py, pz, x, y, z, slot[ray], skin_origin, skin_cell, row_of_node, blended, inverse_jacobian[s]
            )
        unit[s, 0], unit[s, 1], unit[s, 2] = (x - low_x) * scale_x, (y - low_y) * scale_y, (z - low_z) * scale_z


@njit(**OPTIONS)
def _decode(first, last, features, hidden, output, bias, start_density, limit, colour, density, columns, layer, raw):
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
        density[first + s] = start_density * np.exp(min(max(raw[3, s], -limit), limit))


@njit(**OPTIONS)
def shade(first, last, unit, table, plan, hidden, output, bias, start_density, limit, features, colour, density, lanes):
    """Fill features, colour and density of the samples first..last at points of the unit box."""
    columns, layer = np.empty((hidden.shape[0], BLOCK), np.float32), np.empty(BLOCK, np.float32)
    raw = np.empty((4, BLOCK), np.float32)
    for start in range(first, last, BLOCK):
        stop = min(start + BLOCK, last)
        for level in range(plan.shape[0]):
            encode_block(unit, table, plan, level, features, start, stop, lanes)
        _decode(start, stop, features, hidden, output, bias, start_density, limit, colour, density, columns, layer, raw)


@njit(**OPTIONS)
def _composite(first, last, owner, density, colour, step, light, weight, before, image):
    for s in range(first, last):
        ray = owner[s]
        passed = np.exp(-density[s] * step)
        before[s] = light[ray]
        weight[s] = light[ray] * (_ONE - passed)
        for channel in range(3):
            image[ray, channel] += weight[s] * colour[s, channel]
        light[ray] *= passed


@njit(**OPTIONS)
def trace(
    origins, directions, frame, slot, jitter, step, most, least_light,
    cell, warp_origin, warp_dims, warp_first, warp_nodes, warp_codes, warp_maps, occupied, low, scale,
    skin_origin, skin_cell, row_of_node, blended,
    bounds, table, plan, hidden, output, bias, start_density, limit, lanes,
    image, light, room, owner, found, distance, inverse_jacobian, unit, features, colour, density, weight, before,
):  # fmt: skip
    """The number of samples, -1 if there was no room for them; fills all that follow `lanes`: see
    `pipeline.kernels.volume_rendering.trace`.
    """
    rays, count = len(origins), 0
    near, stops, stop = np.empty(rays, np.float32), np.empty(rays, np.int64), np.zeros(rays, np.int64)
    left, on = np.full(rays, most), np.empty(RAYS, np.int64)
    for block in range(0, rays, RAYS):
        going = 0
        for ray in range(block, min(block + RAYS, rays)):
            f = frame[ray]
            near[ray], stops[ray] = enter(ray, origins, directions, jitter, step, cell, warp_origin[f], warp_dims[f])
            if stops[ray] > 0:
                on[going] = ray
                going += 1
        while going:
            first = count
            if first + MOST_AT_ONCE > room:
                return -1
            for place in range(going):
                ray, noted = on[place], count
                ahead = AHEAD if light[ray] >= DIM else 1
                count, stop[ray] = go_on(
                    ray, near[ray], stop[ray], stops[ray], count + ahead, count + left[ray],
                    origins, directions, jitter, step, cell, frame[ray],
                    warp_origin, warp_dims, warp_first, warp_nodes, warp_codes, warp_maps,
                    occupied, low, scale, count, found, distance, owner,
                )  # fmt: skip
                left[ray] -= count - noted
            _refine(
                first, count, found, distance, owner, origins, directions, slot,
                skin_origin, skin_cell, row_of_node, blended, bounds, unit, inverse_jacobian,
            )  # fmt: skip
            shade(
                first, count, unit, table, plan, hidden, output, bias, start_density, limit,
                features, colour, density, lanes,
            )  # fmt: skip
            _composite(first, count, owner, density, colour, step, light, weight, before, image)
            lit = 0
            for place in range(going):
                ray = on[place]
                if stop[ray] < stops[ray] and left[ray] > 0 and light[ray] >= least_light:
                    on[lit] = ray
                    lit += 1
            going = lit
    return count
