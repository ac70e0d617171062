"""What the training rays saw in each voxel."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.kernels.common.dispatch import runs_on_numba
from pipeline.kernels.transmittance_stats import cpu as visits_cpu
from pipeline.kernels.transmittance_stats import reference


def update_voxel_maxima(
    points_m: Float[Tensor, "s 3"],
    transmittance: Float[Tensor, "s"],
    weight: Float[Tensor, "s"],
    bounds_m: Float[Tensor, "2 3"],
    shape: tuple[int, int, int],
    max_transmittance: Float[Tensor, "cells"],
    max_weight: Float[Tensor, "cells"],
) -> None:
    """Raise `max_transmittance` and `max_weight` (x slowest) to the largest light and weight of the samples in each
    cell, in place.
    """
    tensors = (points_m, transmittance, weight, bounds_m)
    if runs_on_numba(*tensors, max_transmittance, max_weight):
        arrays = (tensor.detach().numpy() for tensor in tensors)
        visits_cpu.update_voxel_maxima(*arrays, shape, max_transmittance.numpy(), max_weight.numpy())
    else:
        reference.update_voxel_maxima(*tensors, shape, max_transmittance, max_weight)


def transmittance_from_weights(weight: Float[Tensor, "s"], ray_offsets: Int[Tensor, "m"]) -> Float[Tensor, "s"]:
    """Light in [0, 1] that reached each sample: what the samples before it on its ray have left."""
    if not runs_on_numba(weight):
        return reference.transmittance_from_weights(weight.detach(), ray_offsets)
    transmittance = torch.empty_like(weight)
    visits_cpu.transmittance_from_weights(weight.detach().numpy(), ray_offsets.numpy(), transmittance.numpy())
    return transmittance
