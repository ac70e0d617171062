"""Adam (Kingma & Ba 2015), in place on one contiguous tensor, in one pass over memory.

Differences from torch.optim.Adam: the gradient is cleared in the same pass; a gradient that is not finite counts as
zero, so that NaN never reaches a parameter; moments below 1e-30 are set to zero, because denormal numbers made a step
20 times slower.
"""

import torch
from torch import Tensor

from pipeline.kernels.adam import cpu, reference
from pipeline.kernels.common.dispatch import runs_on_cuda, runs_on_numba


def adam_step_(
    parameter: Tensor,
    gradient: Tensor,
    first_moment: Tensor,
    second_moment: Tensor,
    step: int,
    learning_rate: float,
    betas: tuple[float, float] = (0.9, 0.99),
    epsilon: float = 1e-15,
) -> None:
    """Update `parameter` and both moments in place, and set `gradient` to zero.

    Args:
        parameter, gradient, first_moment, second_moment: contiguous, of the same shape.
        step: 1 for the first update (bias correction).
        learning_rate: in units of the parameter.

    Raises ValueError if the shapes differ or a tensor is not contiguous.
    """
    tensors = (parameter.detach(), gradient, first_moment, second_moment)
    if any(tensor.shape != parameter.shape or not tensor.is_contiguous() for tensor in tensors):
        shapes = ", ".join(str(tuple(tensor.shape)) for tensor in tensors)
        raise ValueError(f"parameter, gradient and moments must be contiguous and of one shape, not {shapes}")
    rate = learning_rate * (1 - betas[1] ** step) ** 0.5 / (1 - betas[0] ** step)
    scaled_epsilon = epsilon * (1 - betas[1] ** step) ** 0.5
    with torch.no_grad():
        if runs_on_numba(*tensors):
            flat = [tensor.view(-1).numpy() for tensor in tensors]
            cpu.update(flat[0], flat[1], flat[2], flat[3], rate, betas[0], betas[1], scaled_epsilon)
        elif runs_on_cuda(*tensors):
            from pipeline.kernels.adam import cuda  # only where there is a GPU

            cuda.update(*tensors, rate, betas[0], betas[1], scaled_epsilon)
        else:
            reference.update(*tensors, rate, betas[0], betas[1], scaled_epsilon)
