"""Positional encoding and a deep MLP, as in NeRF (Mildenhall et al. 2020) and Anim-NeRF (Chen et al. 2021)."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

FREQUENCY_COUNT = 10
"""Octaves of the positional encoding (Mildenhall et al. 2020, section 5.1)."""
LAYER_COUNT = 8
"""Layers of the whole network, including the hidden layer of `RadianceField`. Anim-NeRF uses a width of 256."""
SKIP_LAYER = 4
"""Index of the layer that takes the encoding as a second input."""


class PositionalMlp(torch.nn.Module):
    """`layers` fully connected ReLU layers of width `width`; the hidden layer of `RadianceField` follows them."""

    def __init__(self, layers: int, width: int, seed: int = 0) -> None:
        super().__init__()
        self.width = width
        rng = torch.Generator().manual_seed(seed)
        encoded = 3 + 6 * FREQUENCY_COUNT
        self.layers = torch.nn.ModuleList()
        for layer in range(layers):
            inputs = encoded if layer == 0 else width + (encoded if layer == SKIP_LAYER else 0)
            linear = torch.nn.Linear(inputs, width)
            limit = math.sqrt(6 / inputs)
            linear.weight.data.uniform_(-limit, limit, generator=rng)
            linear.bias.data.zero_()
            self.layers.append(linear)

    def forward(self, unit: Float[Tensor, "n 3"]) -> Float[Tensor, "n width"]:
        """Compute the features of points; coordinates are in [0, 1], relative to the bounding box of the field."""
        phases = (2 * unit - 1)[:, :, None] * (math.pi * 2.0 ** torch.arange(FREQUENCY_COUNT, device=unit.device))
        encoded = torch.cat([unit, phases.sin().flatten(1), phases.cos().flatten(1)], dim=1)
        features = encoded
        for layer, linear in enumerate(self.layers):
            features = torch.relu(linear(torch.cat([features, encoded], dim=1) if layer == SKIP_LAYER else features))
        return features
