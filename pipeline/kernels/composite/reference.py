"""Plain-torch twin of alpha compositing: any dtype, any device, gradients by autograd."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.kernels.common.packing import owner_of_each


def composite(
    density_per_m: Float[Tensor, "s"],
    colour: Float[Tensor, "s c"],
    step_m: Float[Tensor, "s"],
    ray_start: Int[Tensor, "m"],
) -> tuple[Float[Tensor, "n c"], Float[Tensor, "n"], Float[Tensor, "s"]]:
    """Same as `pipeline.kernels.composite.composite`."""
    counts = ray_start.diff()
    ray = owner_of_each(counts)
    depth = density_per_m * step_m
    # One sum runs over all rays: in float32 the first rays' depths would swallow the last ones'.
    before = depth.double().cumsum(0) - depth
    ray_before = torch.cat([before, before.new_zeros(1)])[ray_start[:-1].clamp(max=len(before))]
    weights = torch.exp(ray_before[ray] - before).to(depth) * -torch.expm1(-depth)
    image = colour.new_zeros(len(counts), colour.shape[1]).index_add(0, ray, weights[:, None] * colour)
    alpha = weights.new_zeros(len(counts)).index_add(0, ray, weights)
    return image, alpha, weights.detach()
