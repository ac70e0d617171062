import math

import pytest
import torch

from pipeline.field.baselines.positional_mlp import FREQUENCY_COUNT, SKIP_LAYER, PositionalMlp


def positional_encoding(point):
    """Reference: the point, then sin and cos of pi 2^k (2 x - 1), axis by axis."""
    phases = [math.pi * 2**k * (2 * value - 1) for value in point for k in range(FREQUENCY_COUNT)]
    return [*point, *(math.sin(a) for a in phases), *(math.cos(a) for a in phases)]


def test_the_encoding_enters_at_the_first_layer_and_before_the_skip():
    trunk = PositionalMlp(SKIP_LAYER + 1, 16).requires_grad_(False)
    point = [0.2, 0.55, 0.9]
    encoded = torch.tensor(positional_encoding(point))
    features = encoded
    for index, layer in enumerate(trunk.layers):
        inputs = torch.cat([features, encoded]) if index == SKIP_LAYER else features
        features = (layer.weight @ inputs + layer.bias).clamp(min=0)
    torch.testing.assert_close(trunk(torch.tensor([point]))[0], features, atol=1e-3, rtol=1e-3)
    assert trunk.layers[SKIP_LAYER].in_features == 16 + 3 + 6 * FREQUENCY_COUNT


def test_the_seed_determines_the_network():
    points = torch.rand(5, 3, generator=torch.Generator().manual_seed(0))
    one, same, other = (PositionalMlp(3, 8, seed)(points) for seed in (1, 1, 2))
    assert torch.equal(one, same)
    assert not torch.equal(one, other)


def test_fits_high_frequencies():
    """Twenty stripes, which need the high octaves of the encoding."""
    x = torch.linspace(0, 1, 400)
    points = torch.stack([x, torch.full_like(x, 0.5), torch.full_like(x, 0.5)], dim=1)
    stripes = torch.sign(torch.sin(40 * math.pi * x))
    torch.manual_seed(0)
    trunk, last = PositionalMlp(3, 32), torch.nn.Linear(32, 1)
    optimiser = torch.optim.Adam([*trunk.parameters(), *last.parameters()], lr=3e-3)
    for _ in range(150):
        error = (last(trunk(points))[:, 0] - stripes).square().mean()
        optimiser.zero_grad()
        error.backward()
        optimiser.step()
    assert float(error.detach()) < 0.1


@pytest.mark.parametrize("layers", [1, 7])
def test_width_of_the_features(layers):
    assert PositionalMlp(layers, 24)(torch.rand(2, 3)).shape == (2, 24)
