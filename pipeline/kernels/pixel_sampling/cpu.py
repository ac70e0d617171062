"""Compiled loops that draw the pixels of a training step, and the rays through them.

Draws are stratified: of n draws from a list of pixels, each has an n-th of the list to itself. They come in the list's
order, so that neighbouring rays read the same memory, and no part of a body is passed over by chance.
"""

import numpy as np
from numba import njit

from pipeline.kernels.common.numba_options import OPTIONS

CANDIDATES = 4
"""Pixels that are drawn for each that is then chosen by the error around it."""
_LEAST = np.float64(1e-12)
"""Stands for an error of zero, so that of many such no one is preferred."""


@njit(**OPTIONS)
def _one_of_each_part(first, last, count, numbers, rows):
    """Fill rows[:count] with one of each n-th of first..last."""
    width = np.float64(last - first) / np.float64(max(count, 1))
    for i in range(count):
        rows[i] = min(first + np.int64((np.float64(i) + numbers[i]) * width), last - 1)


@njit(**OPTIONS)
def _choose(candidates, weight, count, numbers, rows):
    """Fill rows[:count] with candidates, each as often as its weight has it; weight is made a running sum."""
    for i in range(1, len(candidates)):
        weight[i] += weight[i - 1]
    part, place, end = weight[-1] / np.float64(max(count, 1)), 0, len(candidates) - 1
    for i in range(count):
        while place < end and weight[place] <= (np.float64(i) + numbers[i]) * part:
            place += 1
        rows[i] = candidates[place]


@njit(**OPTIONS)
def _tile_errors(rows, xy, error, tile, errors):
    """Fill `errors` with those (rows, columns) of the tiles that pixels lie in."""
    for i in range(len(rows)):
        errors[i] = max(np.float64(error[xy[rows[i], 1] // tile, xy[rows[i], 0] // tile]), _LEAST)


@njit(**OPTIONS)
def draw_rows(start, xy, frames, sizes, chosen, error, tile, outlier, numbers, rows, trust):
    """Fill rows and trust: see `pipeline.kernels.pixel_sampling.draw_pixels`. numbers: uniform in [0, 1)."""
    done, used = 0, 0
    for slot in range(len(frames)):
        frame, begun, limit = frames[slot], done, np.inf
        for kind in range(sizes.shape[1]):
            first, last, by_error = start[frame, kind], start[frame, kind + 1], chosen[slot, kind]
            plain = sizes[slot, kind] - by_error
            _one_of_each_part(first, last, plain, numbers[used:], rows[done:])
            if kind == 0 and plain > 0:
                usual = np.empty(plain, np.float64)
                _tile_errors(rows[done : done + plain], xy, error[frame], tile, usual)
                limit = outlier * np.median(usual)
            done, used = done + plain, used + plain
            if by_error > 0:
                candidates = np.empty(CANDIDATES * by_error, np.int64)
                weight = np.empty(len(candidates), np.float64)
                _one_of_each_part(first, last, len(candidates), numbers[used:], candidates)
                used += len(candidates)
                _tile_errors(candidates, xy, error[frame], tile, weight)
                for i in range(len(candidates)):
                    weight[i] = min(weight[i], limit)
                _choose(candidates, weight, by_error, numbers[used:], rows[done:])
                done, used = done + by_error, used + by_error
        found = np.empty(done - begun, np.float64)
        _tile_errors(rows[begun:done], xy, error[frame], tile, found)
        for i in range(done - begun):
            trust[begun + i] = min(1.0, limit / found[i]) ** 4


@njit(**OPTIONS)
def pixel_rays(rows, frame, xy, rgba, inside, focal, centre, origin, axes, origins, directions, colour):
    """Fill origins, directions, colour: see `pipeline.kernels.pixel_sampling.pixel_rays`."""
    for ray in range(len(rows)):
        row, f = rows[ray], frame[ray]
        x = (np.float32(xy[row, 0]) + inside[ray, 0] - centre[0]) / focal[0]
        y = (np.float32(xy[row, 1]) + inside[ray, 1] - centre[1]) / focal[1]
        scale = np.float32(1) / np.sqrt(x * x + y * y + np.float32(1))
        for axis in range(3):
            along = axes[f, axis, 0] * x + axes[f, axis, 1] * y + axes[f, axis, 2]
            directions[ray, axis], origins[ray, axis] = scale * along, origin[f, axis]
        for channel in range(4):
            colour[ray, channel] = np.float32(rgba[row, channel]) / np.float32(255)


@njit(**OPTIONS)
def note_errors(rows, frame, xy, erred, memory, tile, error):
    """Change `error` in place: see `pipeline.kernels.pixel_sampling.note_errors`."""
    total, count = np.zeros(error.shape[1:], np.float64), np.zeros(error.shape[1:], np.int64)
    for ray in range(len(rows)):
        y, x = xy[rows[ray], 1] // tile, xy[rows[ray], 0] // tile
        total[y, x] += (abs(erred[ray, 0]) + abs(erred[ray, 1]) + abs(erred[ray, 2])) / np.float32(3)
        count[y, x] += 1
        if ray + 1 < len(rows) and frame[ray + 1] == frame[ray]:
            continue
        known = error[frame[ray]]
        for y in range(total.shape[0]):
            for x in range(total.shape[1]):
                if count[y, x] > 0:
                    kept = memory ** count[y, x]
                    known[y, x] = kept * known[y, x] + (1.0 - kept) * total[y, x] / np.float64(count[y, x])
        total[:], count[:] = 0.0, 0
