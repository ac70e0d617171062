"""Compiled loop that notes the largest values in each voxel; one thread, so that there is nothing to race for."""

import numpy as np
from numba import njit


@njit(cache=True, fastmath={"arcp", "nsz"}, error_model="numpy")
def record(points, light, weight, bounds, shape, reached, gave):
    """See `pipeline.kernels.visits.record_visits`."""
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
