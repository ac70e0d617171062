"""CUDA kernel of the statistics of rays: a thread for each sample."""

import numpy as np
from numba import cuda
from torch import Tensor

from pipeline.kernels.common.cuda import CUDA_OPTIONS, launch

_ZERO = np.float32(0)


@cuda.jit(**CUDA_OPTIONS)
def update_maxima(points, transmittance, weight, bounds, shape, max_transmittance, max_weight):
    """Update the maxima of the voxels that contain a sample."""
    s = cuda.grid(1)
    if s >= points.shape[0]:
        return
    size_x, size_y, size_z = shape
    x = (points[s, 0] - bounds[0, 0]) * (np.float32(size_x) / (bounds[1, 0] - bounds[0, 0]))
    y = (points[s, 1] - bounds[0, 1]) * (np.float32(size_y) / (bounds[1, 1] - bounds[0, 1]))
    z = (points[s, 2] - bounds[0, 2]) * (np.float32(size_z) / (bounds[1, 2] - bounds[0, 2]))
    inside_x, inside_y = _ZERO <= x < np.float32(size_x), _ZERO <= y < np.float32(size_y)
    if inside_x and inside_y and _ZERO <= z < np.float32(size_z):
        cell = (int(x) * size_y + int(y)) * size_z + int(z)
        cuda.atomic.max(max_transmittance, cell, transmittance[s])
        cuda.atomic.max(max_weight, cell, weight[s])


def update_voxel_maxima(
    points: Tensor,
    transmittance: Tensor,
    weight: Tensor,
    bounds: Tensor,
    shape: tuple[int, int, int],
    max_transmittance: Tensor,
    max_weight: Tensor,
) -> None:
    """Do `pipeline.kernels.transmittance_stats.update_voxel_maxima`."""
    arrays = points, transmittance, weight, bounds, shape, max_transmittance, max_weight
    launch(update_maxima, len(points), *arrays)
