"""Losses of the field training (IHM, Wang et al. 2025, section 2.4).

Letters: n rays, e points that should be empty.
"""

from jaxtyping import Float
from torch import Tensor

from pipeline.field.settings import FieldSettings
from pipeline.kernels.ray_losses import ray_losses

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
