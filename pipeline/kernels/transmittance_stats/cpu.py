"""Compiled loops of the statistics of rays. One thread writes all voxels, so that there is no race."""

import numpy as np
from numba import njit, prange

from pipeline.kernels.common.numba_options import NJIT_OPTIONS


@njit(parallel=True, **NJIT_OPTIONS)
def transmittance_from_weights(weight, ray_offsets, transmittance):
    """Fill `transmittance`: see `pipeline.kernels.transmittance_stats.transmittance_from_weights`."""
    for ray in prange(ray_offsets.shape[0] - 1):
        remaining = np.float32(1)
        for s in range(ray_offsets[ray], ray_offsets[ray + 1]):
            transmittance[s] = max(remaining, np.float32(0))
            remaining -= weight[s]


@njit(**NJIT_OPTIONS)
def update_voxel_maxima(points, transmittance, weight, bounds, shape, max_transmittance, max_weight):
    """Update the maxima: see `pipeline.kernels.transmittance_stats.update_voxel_maxima`."""
    scale_x = np.float32(shape[0]) / (bounds[1, 0] - bounds[0, 0])
    scale_y = np.float32(shape[1]) / (bounds[1, 1] - bounds[0, 1])
    scale_z = np.float32(shape[2]) / (bounds[1, 2] - bounds[0, 2])
    for s in range(points.shape[0]):
        i = int(np.floor((points[s, 0] - bounds[0, 0]) * scale_x))
        j = int(np.floor((points[s, 1] - bounds[0, 1]) * scale_y))
        k = int(np.floor((points[s, 2] - bounds[0, 2]) * scale_z))
        if 0 <= i < shape[0] and 0 <= j < shape[1] and 0 <= k < shape[2]:
            cell = (i * shape[1] + j) * shape[2] + k
            max_transmittance[cell] = max(max_transmittance[cell], transmittance[s])
            max_weight[cell] = max(max_weight[cell], weight[s])
