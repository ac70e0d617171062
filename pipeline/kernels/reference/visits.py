"""Plain-torch twin of the voxel records."""

import torch
from torch import Tensor


def record(
    points: Tensor,
    light: Tensor,
    weight: Tensor,
    bounds: Tensor,
    shape: tuple[int, int, int],
    reached: Tensor,
    gave: Tensor,
) -> None:
    """Same as `pipeline.kernels.visits.record_visits`."""
    size = torch.tensor(shape, device=points.device)
    index = ((points - bounds[0]) * (size / (bounds[1] - bounds[0]))).floor().long()
    inside = ((index >= 0) & (index < size)).all(-1)
    i, j, k = index[inside].unbind(-1)
    cell = (i * shape[1] + j) * shape[2] + k
    reached.scatter_reduce_(0, cell, light.detach()[inside], "amax")
    gave.scatter_reduce_(0, cell, weight.detach()[inside], "amax")
