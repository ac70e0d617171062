"""What NeRF and Anim-NeRF have in the hash grid's place: sines and cosines of the position, and a deep network."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

FREQUENCY_COUNT = 10
"""Octaves of the encoding (Mildenhall et al. 2020, section 5.1)."""
LAYER_COUNT = 8
"""Of the whole network, the field's own hidden layer included (Anim-NeRF's width is 256)."""
SKIP_LAYER = 4
"""Before this layer the encoding enters again."""


class PositionalMlp(torch.nn.Module):
    """Features of points from `layers` layers of width `width`; the field's own hidden layer follows as one more."""

    def __init__(self, layers: int, width: int, seed: int = 0) -> None:
        super().__init__()
        self.width = width
        random = torch.Generator().manual_seed(seed)
        encoded = 3 + 6 * FREQUENCY_COUNT
        self.layers = torch.nn.ModuleList()
        for layer in range(layers):
            inputs = encoded if layer == 0 else width + (encoded if layer == SKIP_LAYER else 0)
            linear = torch.nn.Linear(inputs, width)
            limit = math.sqrt(6 / inputs)
            linear.weight.data.uniform_(-limit, limit, generator=random)
            linear.bias.data.zero_()
            self.layers.append(linear)

    def forward(self, unit: Float[Tensor, "n 3"]) -> Float[Tensor, "n width"]:
        """Features of points of the unit box."""
        phases = (2 * unit - 1)[:, :, None] * (math.pi * 2.0 ** torch.arange(FREQUENCY_COUNT, device=unit.device))
        encoded = torch.cat([unit, phases.sin().flatten(1), phases.cos().flatten(1)], dim=1)
        features = encoded
        for layer, linear in enumerate(self.layers):
            features = torch.relu(linear(torch.cat([features, encoded], dim=1) if layer == SKIP_LAYER else features))
        return features
