"""What the training rays saw in each voxel."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.kernels.common.dispatch import runs_on_numba
from pipeline.kernels.transmittance_stats import cpu as visits_cpu
from pipeline.kernels.transmittance_stats import reference


def record_visits(
    points_m: Float[Tensor, "s 3"],
    light: Float[Tensor, "s"],
    weight: Float[Tensor, "s"],
    bounds_m: Float[Tensor, "2 3"],
    shape: tuple[int, int, int],
    reached: Float[Tensor, "cells"],
    gave: Float[Tensor, "cells"],
) -> None:
    """Raise `reached` and `gave` (x slowest) to the largest light and weight of the samples in each cell, in place."""
    tensors = (points_m, light, weight, bounds_m)
    if runs_on_numba(*tensors, reached, gave):
        arrays = (tensor.detach().numpy() for tensor in tensors)
        visits_cpu.record(*arrays, shape, reached.numpy(), gave.numpy())
    else:
        reference.record(*tensors, shape, reached, gave)


def light_before(weight: Float[Tensor, "s"], ray_start: Int[Tensor, "m"]) -> Float[Tensor, "s"]:
    """Light in [0, 1] that reached each sample: what the samples before it on its ray have left."""
    if not runs_on_numba(weight):
        return reference.light_before(weight.detach(), ray_start)
    light = torch.empty_like(weight)
    visits_cpu.light_before(weight.detach().numpy(), ray_start.numpy(), light.numpy())
    return light
