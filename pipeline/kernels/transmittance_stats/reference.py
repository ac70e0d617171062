"""Plain-torch twin of the voxel records."""

import torch
from torch import Tensor


def light_before(weight: Tensor, ray_start: Tensor) -> Tensor:
    """Same as `pipeline.kernels.transmittance_stats.light_before`."""
    before = weight.double().cumsum(0) - weight
    first = torch.repeat_interleave(ray_start[:-1], ray_start.diff())
    return (1 - (before - before[first])).clamp(0, 1).to(weight.dtype)


def record(
    points: Tensor,
    light: Tensor,
    weight: Tensor,
    bounds: Tensor,
    shape: tuple[int, int, int],
    reached: Tensor,
    gave: Tensor,
) -> None:
    """Same as `pipeline.kernels.transmittance_stats.record_visits`."""
    size = torch.tensor(shape, device=points.device)
    index = ((points - bounds[0]) * (size / (bounds[1] - bounds[0]))).floor().long()
    inside = ((index >= 0) & (index < size)).all(-1)
    i, j, k = index[inside].unbind(-1)
    cell = (i * shape[1] + j) * shape[2] + k
    reached.scatter_reduce_(0, cell, light.detach()[inside], "amax")
    gave.scatter_reduce_(0, cell, weight.detach()[inside], "amax")
