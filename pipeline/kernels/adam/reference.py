"""Plain-torch reference of Adam: any dtype, any device."""

import torch
from torch import Tensor


def update(
    parameter: Tensor,
    gradient: Tensor,
    first: Tensor,
    second: Tensor,
    rate: float,
    beta1: float,
    beta2: float,
    scaled_epsilon: float,
) -> None:
    """Do `pipeline.kernels.adam.cpu.update`, on tensors of one shape."""
    finite = torch.where(gradient.abs() < 1e18, gradient, 0)
    first.mul_(beta1).add_(finite, alpha=1 - beta1)
    second.mul_(beta2).addcmul_(finite, finite, value=1 - beta2)
    first.mul_(first.abs() > 1e-30)
    second.mul_(second > 1e-30)
    parameter.sub_(rate * first / (second.sqrt() + scaled_epsilon))
    gradient.zero_()
