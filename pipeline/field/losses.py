"""Losses of stage one (IHM, Wang et al. 2025, section 2.4)."""

from jaxtyping import Float
from torch import Tensor

from pipeline.field.config import FieldConfig
from pipeline.kernels.ray_losses import ray_losses


def field_losses(
    image: Float[Tensor, "n 3"],
    alpha: Float[Tensor, "n"],
    rgba: Float[Tensor, "n 4"],
    background: Float[Tensor, "n 3"],
    inlier_weight: Float[Tensor, "n"],
    empty_density_per_m: Float[Tensor, "e"],
    config: FieldConfig,
) -> tuple[dict[str, Tensor], Float[Tensor, "n 3"]]:
    """Weighted losses of some rays, means over them, and their colour errors.

    `density` is the sum over points that should be empty, as a part of the points that a step asks for; the rest and
    the arguments are those of `ray_losses`.
    """
    (colour, opacity, hard), error = ray_losses(image, alpha, rgba, background, inlier_weight, config.huber_delta)
    losses = {"colour": colour, "alpha": config.alpha_weight * opacity, "hard": config.hard_surface_weight * hard}
    if len(empty_density_per_m):
        sample_count = config.empty_points + config.unobserved_points
        losses["density"] = config.empty_density_weight * 0.01 * empty_density_per_m.sum() / sample_count
    return losses, error
