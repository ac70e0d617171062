"""Plain-torch reference of the losses of rays: any dtype, any device, gradients by autograd."""

import math

import torch
from torch import Tensor

HARD_OFFSET = math.log(1 + math.exp(-1))
"""Makes the hard-surface loss zero where alpha is 0 or 1."""


def huber(error: Tensor, delta: float) -> Tensor:
    """Return error² / (2 delta) below delta and |error| - delta / 2 above: slope one for large errors."""
    return torch.nn.functional.huber_loss(error, torch.zeros_like(error), reduction="none", delta=delta) / delta


def hard_surface(alpha: Tensor) -> Tensor:
    """Return -log(exp(-|a|) + exp(-|a - 1|)) + const: 0 for alpha in {0, 1}, largest at 0.5 (Rebain et al. 2022)."""
    return HARD_OFFSET - torch.log(torch.exp(-alpha.abs()) + torch.exp(-(alpha - 1).abs()))


def colour_errors(image: Tensor, alpha: Tensor, rgba: Tensor, background: Tensor) -> Tensor:
    """Return rendered minus filmed colour, both composited on the same background."""
    mask = rgba[:, 3:]
    target = rgba[:, :3] * mask + background * (1 - mask)
    return image + background * (1 - alpha[:, None]) - target


def ray_losses(
    image: Tensor, alpha: Tensor, rgba: Tensor, background: Tensor, confidence: Tensor, delta: float
) -> tuple[Tensor, Tensor]:
    """Do `pipeline.kernels.ray_losses.ray_losses`."""
    error = colour_errors(image, alpha, rgba, background)
    per_ray = huber(error, delta).mean(1), huber(alpha - rgba[:, 3], delta), hard_surface(alpha)
    return torch.stack([(confidence * loss).mean() for loss in per_ray]), error.detach()
