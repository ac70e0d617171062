"""Losses of rendered rays (IHM, Wang et al. 2025, section 2.4) as one operation."""

from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.kernels.common.dispatch import runs_on_cuda, runs_on_numba
from pipeline.kernels.ray_losses import cpu, reference
from pipeline.kernels.ray_losses.cpu import LossInputs

__all__ = ["RayLossGradients", "ray_loss_gradients", "ray_losses"]


class RayLossGradients(NamedTuple):
    """Weighted means of the three losses, colour errors, and the gradients of the sum of the weighted means."""

    losses: Float[Tensor, "3"]
    error: Float[Tensor, "n 3"]
    grad_image: Float[Tensor, "n 3"]
    grad_alpha: Float[Tensor, "n"]


class _RayLosses(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, image: Tensor, alpha: Tensor, rgba: Tensor, background: Tensor, confidence: Tensor, delta: float
    ) -> tuple[Tensor, Tensor]:
        arrays = (tensor.detach().numpy() for tensor in (image, alpha, rgba, background, confidence))
        means, error, ctx.kept = _evaluate(LossInputs(*arrays), delta)
        result = torch.from_numpy(error)
        ctx.mark_non_differentiable(result)
        return torch.from_numpy(means), result

    @staticmethod
    def backward(ctx: Any, grad_means: Tensor, _grad_error: Tensor) -> tuple[Tensor | None, ...]:
        grad_image, grad_alpha = _weighted_gradients(grad_means.numpy(), ctx.kept)
        return torch.from_numpy(grad_image), torch.from_numpy(grad_alpha), None, None, None, None


def _evaluate(inputs: LossInputs, delta: float) -> tuple[np.ndarray, np.ndarray, cpu.GradientArrays]:
    """Return the means of the losses, the colour errors, and the gradients of the sums of the losses."""
    rays = len(inputs.alpha)
    sums, error = np.empty(3, np.float32), np.empty((rays, 3), np.float32)
    gradients = cpu.GradientArrays(*(np.empty(shape, np.float32) for shape in ((rays, 3), (rays, 2), rays)))
    cpu.ray_losses(inputs, np.float32(delta), sums, error, gradients)
    return sums / np.array([3.0 * rays, rays, rays], np.float32), error, gradients


def _weighted_gradients(weights: np.ndarray, of_sums: cpu.GradientArrays) -> tuple[np.ndarray, np.ndarray]:
    """Return the gradients of the means of the losses with some weights (3), with respect to image and alpha."""
    rays = len(of_sums.hard)
    colour, alpha, hard = (weights / np.array([3.0 * rays, rays, rays], np.float32)).astype(np.float32)
    return colour * of_sums.image, colour * of_sums.alpha[:, 0] + alpha * of_sums.alpha[:, 1] + hard * of_sums.hard


def ray_loss_gradients(
    image: Float[Tensor, "n 3"],
    alpha: Float[Tensor, "n"],
    rgba: Float[Tensor, "n 4"],
    background: Float[Tensor, "n 3"],
    confidence: Float[Tensor, "n"],
    huber_delta: float,
    weights: tuple[float, float, float],
) -> RayLossGradients:
    """Do `ray_losses` and its backward pass without autograd, on the CPU or a CUDA GPU; `weights` of the means."""
    tensors = image, alpha, rgba, background, confidence
    if runs_on_cuda(*tensors):
        from pipeline.kernels.ray_losses import cuda  # only where there is a GPU

        return RayLossGradients(*cuda.ray_loss_gradients(*tensors, huber_delta, weights))
    means, error, of_sums = _evaluate(LossInputs(*(tensor.numpy() for tensor in tensors)), huber_delta)
    factors = np.array(weights, np.float32)
    arrays = factors * means, error, *_weighted_gradients(factors, of_sums)
    return RayLossGradients(*(torch.from_numpy(array) for array in arrays))


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
