"""Appearance by a learnt feature: a diffuse colour and three numbers a vertex, and a network of the view direction.

colour = diffuse + network(feature, direction), as in NeRF2Mesh (Tang et al., "Delicate textured mesh recovery from NeRF
via adaptive surface refinement", 2023), whose specular feature IHM has. The network has one hidden layer of 32 units;
the square of what it adds is penalised, so that it adds only what the diffuse colour cannot show. Here linear colours
are added, and the diffuse colour is multiplied by a known irradiance, which is 1 where the light is not known.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from pipeline.geometry.colour import linear_to_srgb

FEATURES, HIDDEN = 3, 32
STEPS, ROWS_PER_STEP, LEARNING_RATE = 1_500, 16_384, 1e-2
START_LOGIT = -4.0
"""Of what the network adds at the start: 0.02."""


@dataclass(frozen=True)
class FeatureRows:
    """What frames show of vertices, one row a vertex and frame.

    Attributes:
        vertex: of each row.
        direction: to the camera, unit, canonical space.
        irradiance: linear, relative to the mean of the video.
        colour: sRGB in [0, 1]. weight: of the row, > 0.
    """

    vertex: Int[Tensor, "k"]
    direction: Float[Tensor, "k 3"]
    irradiance: Float[Tensor, "k 3"]
    colour: Float[Tensor, "k 3"]
    weight: Float[Tensor, "k"]

    def select(self, rows: Int[Tensor, "m"]) -> "FeatureRows":
        """Return some rows."""
        columns = (self.vertex, self.direction, self.irradiance, self.colour, self.weight)
        return FeatureRows(*(column[rows] for column in columns))


class LearntFeature(nn.Module):
    """Diffuse colour and feature of each vertex, and the network of the added colour.

    albedo: linear, in [0, 1], to start from.
    """

    def __init__(self, albedo: Float[Tensor, "v 3"]) -> None:
        super().__init__()
        self.diffuse_logit = nn.Parameter(torch.logit(albedo.clamp(1e-3, 1.0 - 1e-3)))
        self.feature = nn.Parameter(0.1 * torch.randn(len(albedo), FEATURES))
        last = nn.Linear(HIDDEN, 3)
        nn.init.constant_(last.bias, START_LOGIT)
        self.network = nn.Sequential(nn.Linear(FEATURES + 3, HIDDEN), nn.ReLU(), last)

    def diffuse(self) -> Float[Tensor, "v 3"]:
        """Return the linear diffuse colours."""
        return torch.sigmoid(self.diffuse_logit)

    def added(self, rows: FeatureRows) -> Float[Tensor, "k 3"]:
        """Return the linear colour that the network adds to each row."""
        features = torch.sigmoid(self.feature)[rows.vertex]
        return torch.sigmoid(self.network(torch.cat([features, rows.direction], dim=1)))

    def colour(self, rows: FeatureRows, added: Float[Tensor, "k 3"]) -> Float[Tensor, "k 3"]:
        """Return the sRGB colour of each row."""
        linear = self.diffuse()[rows.vertex] * rows.irradiance + added
        return linear_to_srgb(linear.clamp(1e-4, 1.0))


def fit_feature(
    rows: FeatureRows, albedo: Float[Tensor, "v 3"], penalty: float, seed: int, steps: int = STEPS
) -> LearntFeature:
    """Fit the model to what training frames show, by Adam.

    Args:
        rows: of training frames.
        albedo: linear, to start from.
        penalty: weight of the mean square of what the network adds, against the squared error of the sRGB colour.
        seed: of the start and of the rows of each step.
        steps: of Adam.
    """
    torch.manual_seed(seed)
    model = LearntFeature(albedo)
    optimiser = torch.optim.Adam(model.parameters(), lr=LEARNING_RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    for _ in range(steps):
        part = rows.select(torch.randint(len(rows.vertex), (min(ROWS_PER_STEP, len(rows.vertex)),)))
        added = model.added(part)
        squared = ((model.colour(part, added) - part.colour) ** 2 + penalty * added**2).sum(dim=1)
        optimiser.zero_grad()
        torch.mean(part.weight * squared).backward()
        optimiser.step()
        schedule.step()
    return model.requires_grad_(requires_grad=False)


def mean_squared_error(model: LearntFeature, rows: FeatureRows) -> float:
    """Return the weighted mean squared error of the sRGB colours of some rows."""
    squared = ((model.colour(rows, model.added(rows)) - rows.colour) ** 2).mean(dim=1)
    return float((rows.weight * squared).sum() / rows.weight.sum())
