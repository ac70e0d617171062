"""Losses of stage one (IHM, Wang et al. 2025, section 2.4)."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.avatar.field_config import FieldConfig

HARD_OFFSET = math.log(1 + math.exp(-1))
"""Makes the hard-surface loss zero where alpha is 0 or 1."""


def huber(error: Float[Tensor, "..."], delta: float) -> Float[Tensor, "..."]:
    """error² / (2 delta) below delta, |error| - delta / 2 above: slope one for large errors whatever delta is."""
    return torch.nn.functional.huber_loss(error, torch.zeros_like(error), reduction="none", delta=delta) / delta


def hard_surface(alpha: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
    """-log(exp(-|a|) + exp(-|a - 1|)) + const: 0 for alpha in {0, 1}, largest at one half (LOLNeRF, Rebain et al.
    2022).
    """
    return HARD_OFFSET - torch.log(torch.exp(-alpha.abs()) + torch.exp(-(alpha - 1).abs()))


def colour_errors(
    image: Float[Tensor, "n 3"],
    alpha: Float[Tensor, "n"],
    rgba: Float[Tensor, "n 4"],
    background: Float[Tensor, "n 3"],
) -> Float[Tensor, "n 3"]:
    """What is shown less what was filmed, the same background behind both.

    image: premultiplied colour. rgba: straight colour and mask of the pixels. background: random for each ray, so that
    no colour can pass for transparency.
    """
    mask = rgba[:, 3:]
    target = rgba[:, :3] * mask + background * (1 - mask)
    return image + background * (1 - alpha[:, None]) - target


def field_losses(
    colour_error: Float[Tensor, "n 3"],
    alpha: Float[Tensor, "n"],
    mask: Float[Tensor, "n"],
    empty_density_per_m: Float[Tensor, "e"],
    config: FieldConfig,
) -> dict[str, Tensor]:
    """Weighted losses of some rays, means over them; `density`: the sum over points that should be empty, as a part of
    the points that a step asks for.

    colour_error: as `colour_errors` has it.
    """
    losses = {
        "colour": huber(colour_error, config.huber_delta).mean(),
        "alpha": config.weight_alpha * huber(alpha - mask, config.huber_delta).mean(),
        "hard": config.weight_hard * hard_surface(alpha).mean(),
    }
    if len(empty_density_per_m):
        asked = config.empty_points + config.hidden_points
        losses["density"] = config.weight_density * 0.01 * empty_density_per_m.sum() / asked
    return losses
