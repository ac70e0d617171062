"""Losses of rendered rays (IHM, Wang et al. 2025, section 2.4) as one operation."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.kernels.common.dispatch import runs_on_numba
from pipeline.kernels.ray_losses import cpu, reference


class _RayLosses(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, image: Tensor, alpha: Tensor, rgba: Tensor, background: Tensor, confidence: Tensor, delta: float
    ) -> tuple[Tensor, Tensor]:
        rays = len(alpha)
        sums, error = torch.empty(3), torch.empty(rays, 3)
        gradients = cpu.GradientArrays(
            np.empty((rays, 3), np.float32), np.empty((rays, 2), np.float32), np.empty(rays, np.float32)
        )
        inputs = cpu.LossInputs(*(tensor.detach().numpy() for tensor in (image, alpha, rgba, background, confidence)))
        cpu.ray_losses(inputs, np.float32(delta), sums.numpy(), error.numpy(), gradients)
        counts = torch.tensor([3.0 * rays, rays, rays])
        ctx.kept = counts, gradients
        ctx.mark_non_differentiable(error)
        return sums / counts, error

    @staticmethod
    def backward(ctx: Any, grad_means: Tensor, _grad_error: Tensor) -> tuple[Tensor | None, ...]:
        counts, (grad_image, grad_alpha, grad_hard) = ctx.kept
        colour, alpha, hard = (grad_means / counts).numpy()
        total = colour * grad_alpha[:, 0] + alpha * grad_alpha[:, 1] + hard * grad_hard
        return torch.from_numpy(colour * grad_image), torch.from_numpy(total), None, None, None, None


def ray_losses(
    image: Float[Tensor, "n 3"],
    alpha: Float[Tensor, "n"],
    rgba: Float[Tensor, "n 4"],
    background: Float[Tensor, "n 3"],
    confidence: Float[Tensor, "n"],
    huber_delta: float,
) -> tuple[Float[Tensor, "3"], Float[Tensor, "n 3"]]:
    """Return the confidence-weighted means of three losses over the rays, and the colour error of each ray.

    The losses: Huber loss of the colour error, with slope one beyond `huber_delta`; Huber loss of alpha - mask; hard
    surface loss, which is zero for an alpha of 0 or 1 (LOLNeRF, Rebain et al. 2022). They are differentiable in image
    and alpha; the colour errors are not differentiable.

    Args:
        image: premultiplied colour of the rendering.
        alpha: opacity of the rendering.
        rgba: straight colour and mask of the pixels, in [0, 1].
        background: random colour for each ray, behind both images, so that no colour can replace transparency.
        confidence: in [0, 1], probability that the pixel shows the person.
    """
    if not runs_on_numba(image, alpha, rgba, background):
        return reference.ray_losses(image, alpha, rgba, background, confidence, huber_delta)
    return _RayLosses.apply(image, alpha, rgba, background, confidence, huber_delta)
