"""Compiled loops that note what rays saw. Voxels are written by one thread, so that there is nothing to race for."""

import numpy as np
from numba import njit, prange

from pipeline.kernels.common.numba_options import OPTIONS


@njit(parallel=True, **OPTIONS)
def light_before(weight, ray_start, light):
    """Fill `light`: see `pipeline.kernels.transmittance_stats.light_before`."""
    for ray in prange(ray_start.shape[0] - 1):
        left = np.float32(1)
        for s in range(ray_start[ray], ray_start[ray + 1]):
            light[s] = max(left, np.float32(0))
            left -= weight[s]


@njit(**OPTIONS)
def record(points, light, weight, bounds, shape, reached, gave):
    """See `pipeline.kernels.transmittance_stats.record_visits`."""
    scale_x = np.float32(shape[0]) / (bounds[1, 0] - bounds[0, 0])
    scale_y = np.float32(shape[1]) / (bounds[1, 1] - bounds[0, 1])
    scale_z = np.float32(shape[2]) / (bounds[1, 2] - bounds[0, 2])
    for s in range(points.shape[0]):
        i = int(np.floor((points[s, 0] - bounds[0, 0]) * scale_x))
        j = int(np.floor((points[s, 1] - bounds[0, 1]) * scale_y))
        k = int(np.floor((points[s, 2] - bounds[0, 2]) * scale_z))
        if 0 <= i < shape[0] and 0 <= j < shape[1] and 0 <= k < shape[2]:
            cell = (i * shape[1] + j) * shape[2] + k
            reached[cell] = max(reached[cell], light[s])
            gave[cell] = max(gave[cell], weight[s])
