"""Alpha compositing of packed, ragged rays.

alpha_i = 1 - exp(-density_i · step_i), weight_i = alpha_i · prod_{k<i} (1 - alpha_k).

Notation: n rays, s samples, c channels. The samples of ray r are ray_offsets[r] : ray_offsets[r + 1], near to far. IHM
(Wang et al. 2025), section 2.2; Max 1995.
"""

from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.kernels.common.dispatch import runs_on_numba
from pipeline.kernels.composite import cpu, reference
from pipeline.kernels.composite.cpu import SampleArrays


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, density: Tensor, colour: Tensor, step_m: Tensor, ray_offsets: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        weights = torch.empty_like(density)
        image = torch.empty(len(ray_offsets) - 1, colour.shape[1])
        alpha = torch.empty(len(ray_offsets) - 1)
        samples = SampleArrays(*(tensor.detach().numpy() for tensor in (density, colour, step_m, ray_offsets)))
        cpu.forward(samples, weights.numpy(), image.numpy(), alpha.numpy())
        ctx.save_for_backward(density, colour, step_m, ray_offsets, weights, alpha)
        ctx.mark_non_differentiable(weights)
        return image, alpha, weights

    @staticmethod
    def backward(ctx: Any, grad_image: Tensor, grad_alpha: Tensor, _grad_weights: Tensor) -> tuple[Tensor | None, ...]:
        *samples, weights, alpha = (tensor.detach() for tensor in ctx.saved_tensors)
        grad_density, grad_colour = torch.empty_like(samples[0]), torch.empty_like(samples[1])
        cpu.backward(
            SampleArrays(*(tensor.numpy() for tensor in samples)),
            weights.numpy(),
            alpha.numpy(),
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
    """Return the premultiplied colour and alpha of every ray, and the weight of every sample.

    Args:
        density_per_m: >= 0. Differentiable.
        colour: any number of channels. Differentiable.
        step_m: length of the ray segment of each sample.
        ray_offsets: n + 1 non-decreasing int64 offsets, from 0 to s.

    Colour and alpha are differentiable; the weights, which serve statistics, are not.

    >>> image, alpha, _ = composite(torch.tensor([1e9]), torch.tensor([[0.5]]), torch.ones(1), torch.tensor([0, 1, 1]))
    >>> image.tolist(), alpha.tolist()
    ([[0.5], [0.0]], [1.0, 0.0])
    """
    if not runs_on_numba(density_per_m, colour, step_m):
        return reference.composite(density_per_m, colour, step_m, ray_offsets)
    return _Composite.apply(density_per_m.contiguous(), colour.contiguous(), step_m.contiguous(), ray_offsets)
