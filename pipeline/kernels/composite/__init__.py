"""Alpha compositing of packed, ragged rays.

alpha_i = 1 - exp(-density_i · step_i), weight_i = alpha_i · prod_{k<i} (1 - alpha_k).

Letters: n rays, s samples, c channels. Samples of a ray lie together, near to far; ray r owns samples
ray_start[r] : ray_start[r + 1]. IHM (Wang et al. 2025), section 2.2; Max 1995.
"""

from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.kernels.common.dispatch import runs_on_numba
from pipeline.kernels.composite import cpu as composite_cpu
from pipeline.kernels.composite import reference


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, density: Tensor, colour: Tensor, step_m: Tensor, ray_offsets: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        weights = torch.empty_like(density)
        image = torch.empty(len(ray_offsets) - 1, colour.shape[1])
        alpha = torch.empty(len(ray_offsets) - 1)
        composite_cpu.forward(
            *(array.numpy() for array in (density, colour, step_m, ray_offsets, weights, image, alpha))
        )
        ctx.save_for_backward(density, colour, step_m, ray_offsets, weights, alpha)
        ctx.mark_non_differentiable(weights)
        return image, alpha, weights

    @staticmethod
    def backward(ctx: Any, grad_image: Tensor, grad_alpha: Tensor, _grad_weights: Tensor) -> tuple[Tensor | None, ...]:
        density, colour, step_m, ray_offsets, weights, alpha = ctx.saved_tensors
        grad_density, grad_colour = torch.empty_like(density), torch.empty_like(colour)
        composite_cpu.backward(
            *(array.detach().numpy() for array in (density, colour, step_m, ray_offsets, weights, alpha)),
            grad_image.contiguous().numpy(),
            grad_alpha.contiguous().numpy(),
            grad_density.numpy(),
            grad_colour.numpy(),
        )
        return grad_density, grad_colour, None, None


def composite(
    density_per_m: Float[Tensor, "s"],
    colour: Float[Tensor, "s c"],
    step_m: Float[Tensor, "s"],
    ray_offsets: Int[Tensor, "m"],
) -> tuple[Float[Tensor, "n c"], Float[Tensor, "n"], Float[Tensor, "s"]]:
    """Premultiplied colour and alpha of every ray, and the weight of every sample.

    Args:
        density_per_m: >= 0. Differentiable.
        colour: any channels. Differentiable.
        step_m: length that each sample stands for.
        ray_start: n + 1 non-decreasing int64 offsets, from 0 to s.

    The weights carry no gradient (they serve statistics); colour and alpha do.

    >>> image, alpha, _ = composite(torch.tensor([1e9]), torch.tensor([[0.5]]), torch.ones(1), torch.tensor([0, 1, 1]))
    >>> image.tolist(), alpha.tolist()
    ([[0.5], [0.0]], [1.0, 0.0])
    """
    if not runs_on_numba(density_per_m, colour, step_m):
        return reference.composite(density_per_m, colour, step_m, ray_offsets)
    return _Composite.apply(density_per_m.contiguous(), colour.contiguous(), step_m.contiguous(), ray_offsets)
