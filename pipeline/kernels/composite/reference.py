"""Plain-torch reference of alpha compositing: any dtype, any device, gradients by autograd."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.kernels.common.packing import segment_ids_from_counts


def composite(
    density_per_m: Float[Tensor, "s"],
    colour: Float[Tensor, "s c"],
    step_m: Float[Tensor, "s"],
    ray_offsets: Int[Tensor, "m"],
) -> tuple[Float[Tensor, "n c"], Float[Tensor, "n"], Float[Tensor, "s"]]:
    """Do `pipeline.kernels.composite.composite`."""
    counts = ray_offsets.diff()
    ray = segment_ids_from_counts(counts)
    optical_depth = density_per_m * step_m
    # One cumulative sum over all rays: in float32 the depths of the first rays would cancel those of the last rays.
    optical_depth_before = optical_depth.double().cumsum(0) - optical_depth
    ray_optical_depth_before = torch.cat([optical_depth_before, optical_depth_before.new_zeros(1)])[
        ray_offsets[:-1].clamp(max=len(optical_depth_before))
    ]
    weights = torch.exp(ray_optical_depth_before[ray] - optical_depth_before).to(optical_depth) * -torch.expm1(
        -optical_depth
    )
    image = colour.new_zeros(len(counts), colour.shape[1]).index_add(0, ray, weights[:, None] * colour)
    alpha = weights.new_zeros(len(counts)).index_add(0, ray, weights)
    return image, alpha, weights.detach()
