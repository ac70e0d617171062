"""Plain-torch reference of the statistics of rays: any dtype, any device."""

import torch
from torch import Tensor


def transmittance_from_weights(weight: Tensor, ray_offsets: Tensor) -> Tensor:
    """Do `pipeline.kernels.transmittance_stats.transmittance_from_weights`."""
    weight_before = weight.double().cumsum(0) - weight
    first = torch.repeat_interleave(ray_offsets[:-1], ray_offsets.diff())
    return (1 - (weight_before - weight_before[first])).clamp(0, 1).to(weight.dtype)


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
    size = torch.tensor(shape, device=points.device)
    index = ((points - bounds[0]) * (size / (bounds[1] - bounds[0]))).floor().long()
    inside = ((index >= 0) & (index < size)).all(-1)
    i, j, k = index[inside].unbind(-1)
    cell = (i * shape[1] + j) * shape[2] + k
    max_transmittance.scatter_reduce_(0, cell, transmittance.detach()[inside], "amax")
    max_weight.scatter_reduce_(0, cell, weight.detach()[inside], "amax")
