"""Compiled loops that draw the pixels of a training step, and generate the rays through them.

Sampling is stratified: each of n samples comes from its own n-th of a list of pixels. The samples are in the order of
the list, so that neighbouring rays read the same memory and no part of a body is missed by chance.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from pipeline.kernels.common.numba_options import NJIT_OPTIONS

CANDIDATES_PER_SAMPLE = 4
"""Candidates for each pixel that is drawn by error sampling."""
_MIN_ERROR = np.float64(1e-12)
"""Lower limit of the error of a tile, so that tiles without error are all equally likely."""


class PixelRays(NamedTuple):
    """Output: origins (n, 3), directions (n, 3) and RGBA (n, 4) of rays."""

    origins: np.ndarray
    directions: np.ndarray
    rgba: np.ndarray


@njit(**NJIT_OPTIONS)
def _stratified_indices(first, last, count, uniforms, rows):
    """Fill rows[:count] with one row of each of `count` equal parts of first..last."""
    width = np.float64(last - first) / np.float64(max(count, 1))
    for i in range(count):
        rows[i] = min(first + np.int64((np.float64(i) + uniforms[i]) * width), last - 1)


@njit(**NJIT_OPTIONS)
def _systematic_resampling(candidates, weight, count, uniforms, rows):
    """Fill rows[:count] with candidates in proportion to their weights; `weight` becomes its cumulative sum."""
    for i in range(1, len(candidates)):
        weight[i] += weight[i - 1]
    part, index, end = weight[-1] / np.float64(max(count, 1)), 0, len(candidates) - 1
    for i in range(count):
        while index < end and weight[index] <= (np.float64(i) + uniforms[i]) * part:
            index += 1
        rows[i] = candidates[index]


@njit(**NJIT_OPTIONS)
def _tile_errors(rows, xy, error, tile, errors):
    """Fill `errors` with the errors of the tiles of pixels; `error` (rows, columns) is that of one frame."""
    for i in range(len(rows)):
        errors[i] = max(np.float64(error[xy[rows[i], 1] // tile, xy[rows[i], 0] // tile]), _MIN_ERROR)


@njit(**NJIT_OPTIONS)
def sample_pixels(pixels, samples, tiles, uniforms, rows, confidence):
    """Fill rows and confidence: see `pipeline.kernels.pixel_sampling.sample_pixels`."""
    offsets, xy = pixels
    frames, sizes, error_sampled_sizes = samples
    error, tile, outlier_ratio = tiles
    written, consumed = 0, 0
    for batch_index in range(len(frames)):
        frame, frame_start, limit = frames[batch_index], written, np.inf
        for pixel_class in range(sizes.shape[1]):
            first, last = offsets[frame, pixel_class], offsets[frame, pixel_class + 1]
            error_sampled = error_sampled_sizes[batch_index, pixel_class]
            uniform_count = sizes[batch_index, pixel_class] - error_sampled
            _stratified_indices(first, last, uniform_count, uniforms[consumed:], rows[written:])
            if pixel_class == 0 and uniform_count > 0:
                uniform_errors = np.empty(uniform_count, np.float64)
                _tile_errors(rows[written : written + uniform_count], xy, error[frame], tile, uniform_errors)
                limit = outlier_ratio * np.median(uniform_errors)
            written, consumed = written + uniform_count, consumed + uniform_count
            if error_sampled > 0:
                candidates = np.empty(CANDIDATES_PER_SAMPLE * error_sampled, np.int64)
                weight = np.empty(len(candidates), np.float64)
                _stratified_indices(first, last, len(candidates), uniforms[consumed:], candidates)
                consumed += len(candidates)
                _tile_errors(candidates, xy, error[frame], tile, weight)
                for i in range(len(candidates)):
                    weight[i] = min(weight[i], limit)
                _systematic_resampling(candidates, weight, error_sampled, uniforms[consumed:], rows[written:])
                written, consumed = written + error_sampled, consumed + error_sampled
        sample_errors = np.empty(written - frame_start, np.float64)
        _tile_errors(rows[frame_start:written], xy, error[frame], tile, sample_errors)
        for i in range(written - frame_start):
            confidence[frame_start + i] = min(1.0, limit / sample_errors[i]) ** 4


@njit(**NJIT_OPTIONS)
def generate_pixel_rays(rows, frame, xy, rgba, pixel_offset, cameras, rays):
    """Fill `rays`: see `pipeline.kernels.pixel_sampling.generate_pixel_rays`."""
    focal, centre, origin, axes = cameras
    origins, directions, colour = rays
    for ray in range(len(rows)):
        row, f = rows[ray], frame[ray]
        x = (np.float32(xy[row, 0]) + pixel_offset[ray, 0] - centre[0]) / focal[0]
        y = (np.float32(xy[row, 1]) + pixel_offset[ray, 1] - centre[1]) / focal[1]
        scale = np.float32(1) / np.sqrt(x * x + y * y + np.float32(1))
        for axis in range(3):
            along = axes[f, axis, 0] * x + axes[f, axis, 1] * y + axes[f, axis, 2]
            directions[ray, axis], origins[ray, axis] = scale * along, origin[f, axis]
        for channel in range(4):
            colour[ray, channel] = np.float32(rgba[row, channel]) / np.float32(255)


@njit(**NJIT_OPTIONS)
def update_error_map(rows, frame, xy, colour_error, decay, tile, error):
    """Update `error` in place: see `pipeline.kernels.pixel_sampling.update_error_map`."""
    total, count = np.zeros(error.shape[1:], np.float64), np.zeros(error.shape[1:], np.int64)
    for ray in range(len(rows)):
        y, x = xy[rows[ray], 1] // tile, xy[rows[ray], 0] // tile
        total[y, x] += (abs(colour_error[ray, 0]) + abs(colour_error[ray, 1]) + abs(colour_error[ray, 2])) / np.float32(
            3
        )
        count[y, x] += 1
        if ray + 1 < len(rows) and frame[ray + 1] == frame[ray]:
            continue
        frame_error = error[frame[ray]]
        for y in range(total.shape[0]):
            for x in range(total.shape[1]):
                if count[y, x] > 0:
                    retained = decay ** count[y, x]
                    frame_error[y, x] = retained * frame_error[y, x] + (1.0 - retained) * total[y, x] / np.float64(
                        count[y, x]
                    )
        total[:], count[:] = 0.0, 0
