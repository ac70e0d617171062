"""Losses of the field training (IHM, Wang et al. 2025, section 2.4).

Letters: n rays, e points that should be empty.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.field.settings import FieldSettings
from pipeline.kernels.ray_losses import ray_loss_gradients, ray_losses
from pipeline.kernels.volume_rendering import OutputGradients

DENSITY_SCALE_M = 0.01
"""Length that turns the density of empty points (1/m) into the unit of the other losses."""


def field_losses(
    image: Float[Tensor, "n 3"],
    alpha: Float[Tensor, "n"],
    rgba: Float[Tensor, "n 4"],
    background: Float[Tensor, "n 3"],
    inlier_weight: Float[Tensor, "n"],
    empty_density_per_m: Float[Tensor, "e"],
    settings: FieldSettings,
) -> tuple[dict[str, Tensor], Float[Tensor, "n 3"]]:
    """Compute the weighted losses of rays and empty points, by name, and the colour error of each ray.

    image, alpha: rendered colour (premultiplied) and alpha. rgba: colour and mask of the pixels, in [0, 1]. background:
    random colour behind each ray. inlier_weight: weight of each ray, in [0, 1]. Losses of rays are means over n.
    `density` is the sum over the empty points divided by the number of points requested per step, so that the parts of
    a step add up to the whole; it is absent if there are no points.
    """
    (colour, opacity, hard), error = ray_losses(image, alpha, rgba, background, inlier_weight, settings.huber_delta)
    losses = {"colour": colour, "alpha": settings.alpha_weight * opacity, "hard": settings.hard_surface_weight * hard}
    if len(empty_density_per_m):
        point_count = settings.empty_points + settings.unobserved_points
        losses["density"] = settings.empty_density_weight * DENSITY_SCALE_M * empty_density_per_m.sum() / point_count
    return losses, error


def field_loss_gradients(
    image: Float[Tensor, "n 3"],
    alpha: Float[Tensor, "n"],
    rgba: Float[Tensor, "n 4"],
    background: Float[Tensor, "n 3"],
    inlier_weight: Float[Tensor, "n"],
    empty_density_per_m: Float[Tensor, "e"],
    settings: FieldSettings,
    ray_fraction: float,
) -> tuple[dict[str, Tensor], Float[Tensor, "n 3"], OutputGradients]:
    """Do `field_losses` and its backward pass without autograd; return losses, colour errors and gradients.

    ray_fraction: factor of the losses of rays. The gradients are those of the sum of the losses.
    """
    colour, opacity, hard = 1.0, settings.alpha_weight, settings.hard_surface_weight
    weights = ray_fraction * colour, ray_fraction * opacity, ray_fraction * hard
    of_rays = ray_loss_gradients(image, alpha, rgba, background, inlier_weight, settings.huber_delta, weights)
    losses = dict(zip(("colour", "alpha", "hard"), of_rays.losses, strict=True))
    point_count = max(settings.empty_points + settings.unobserved_points, 1)
    slope = settings.empty_density_weight * DENSITY_SCALE_M / point_count
    if len(empty_density_per_m):
        losses["density"] = slope * empty_density_per_m.sum()
    of_density = torch.full_like(empty_density_per_m, slope)
    return losses, of_rays.error, OutputGradients(of_rays.grad_image, of_rays.grad_alpha, of_density)
