"""CUDA kernel of the losses of rays and their gradients: a thread for each ray."""

import math
from typing import NamedTuple

import numpy as np
import torch
from numba import cuda
from torch import Tensor

from pipeline.kernels.common.cuda import CUDA_OPTIONS, device_function, launch
from pipeline.kernels.ray_losses.cpu import huber

_ZERO, _ONE = np.float32(0), np.float32(1)
_HARD_OFFSET = np.float32(math.log(1 + math.exp(-1)))

_huber = device_function(huber)


class RayTensors(NamedTuple):
    """See `pipeline.kernels.ray_losses.cpu.LossInputs`."""

    image: Tensor
    alpha: Tensor
    rgba: Tensor
    background: Tensor
    confidence: Tensor


@cuda.jit(**CUDA_OPTIONS)
def add_ray_losses(rays, delta, weights, losses, error, grad_image, grad_alpha):
    """Add the losses to `losses` (3), and fill the colour errors and the gradients of the sum of the losses."""
    ray = cuda.grid(1)
    image, alpha, rgba, background, confidence = rays
    if ray >= alpha.shape[0]:
        return
    a, mask, ray_confidence = alpha[ray], rgba[ray, 3], confidence[ray]
    of_alpha, colours = _ZERO, _ZERO
    for channel in range(3):
        behind = background[ray, channel]
        residual = image[ray, channel] + behind * (_ONE - a) - (rgba[ray, channel] * mask + behind * (_ONE - mask))
        error[ray, channel] = residual
        value, slope = _huber(residual, delta)
        slope *= ray_confidence * weights[0]
        colours += ray_confidence * value
        grad_image[ray, channel] = slope
        of_alpha -= slope * behind
    value, slope = _huber(a - mask, delta)
    of_alpha += ray_confidence * slope * weights[1]
    full, clear = math.exp(-abs(a)), math.exp(-abs(a - _ONE))
    rising = full if a > _ZERO else (-full if a < _ZERO else _ZERO)
    falling = clear if a > _ONE else (-clear if a < _ONE else _ZERO)
    of_alpha += ray_confidence * (rising + falling) / (full + clear) * weights[2]
    grad_alpha[ray] = of_alpha
    cuda.atomic.add(losses, 0, weights[0] * colours)
    cuda.atomic.add(losses, 1, weights[1] * ray_confidence * value)
    cuda.atomic.add(losses, 2, weights[2] * ray_confidence * (_HARD_OFFSET - math.log(full + clear)))


def ray_loss_gradients(
    image: Tensor,
    alpha: Tensor,
    rgba: Tensor,
    background: Tensor,
    confidence: Tensor,
    delta: float,
    weights: tuple[float, float, float],
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the fields of `pipeline.kernels.ray_losses.RayLossGradients`."""
    rays = max(len(alpha), 1)
    colour_weight, alpha_weight, hard_weight = weights
    factors = tuple(np.float32(x) for x in (colour_weight / (3 * rays), alpha_weight / rays, hard_weight / rays))
    losses, grad_alpha = torch.zeros(3, device=alpha.device), torch.empty_like(alpha)
    error, grad_image = torch.empty_like(image), torch.empty_like(image)
    inputs = RayTensors(*(tensor.contiguous() for tensor in (image, alpha, rgba, background, confidence)))
    launch(add_ray_losses, len(alpha), inputs, np.float32(delta), factors, losses, error, grad_image, grad_alpha)
    return losses, error, grad_image, grad_alpha
