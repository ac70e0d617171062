"""Statistics of training rays for each voxel: the maximum transmittance and the maximum weight of its samples."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.kernels.common.dispatch import runs_on_cuda, runs_on_numba
from pipeline.kernels.transmittance_stats import cpu, reference


def update_voxel_maxima(
    points_m: Float[Tensor, "s 3"],
    transmittance: Float[Tensor, "s"],
    weight: Float[Tensor, "s"],
    bounds_m: Float[Tensor, "2 3"],
    shape: tuple[int, int, int],
    max_transmittance: Float[Tensor, "cells"],
    max_weight: Float[Tensor, "cells"],
) -> None:
    """Update the maximum transmittance and weight of each voxel with those of samples, in place.

    The voxels (x slowest) are a grid of `shape` in the box `bounds_m`. Samples outside the box are ignored.
    """
    tensors = (points_m, transmittance, weight, bounds_m)
    if runs_on_numba(*tensors, max_transmittance, max_weight):
        arrays = (tensor.detach().numpy() for tensor in tensors)
        cpu.update_voxel_maxima(*arrays, shape, max_transmittance.numpy(), max_weight.numpy())
    elif runs_on_cuda(*tensors, max_transmittance, max_weight):
        from pipeline.kernels.transmittance_stats import cuda  # only where there is a GPU

        points_m, transmittance, weight, bounds_m = (tensor.detach().contiguous() for tensor in tensors)
        cuda.update_voxel_maxima(points_m, transmittance, weight, bounds_m, shape, max_transmittance, max_weight)
    else:
        reference.update_voxel_maxima(*tensors, shape, max_transmittance, max_weight)


def transmittance_from_weights(weight: Float[Tensor, "s"], ray_offsets: Int[Tensor, "m"]) -> Float[Tensor, "s"]:
    """Return the transmittance in front of each sample, in [0, 1]: 1 minus the weights of the samples before it.

    ray_offsets: n + 1 offsets of the rays, as in `pipeline.kernels.composite`. Not differentiable.
    """
    if not runs_on_numba(weight):
        return reference.transmittance_from_weights(weight.detach(), ray_offsets)
    transmittance = torch.empty_like(weight)
    cpu.transmittance_from_weights(weight.detach().numpy(), ray_offsets.numpy(), transmittance.numpy())
    return transmittance
