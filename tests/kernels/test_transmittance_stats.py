import torch

from pipeline.kernels.composite import composite
from pipeline.kernels.transmittance_stats import light_before, reference

RAY_START = torch.tensor([0, 3, 3, 7, 8])


def weights_of(density):
    step = torch.full_like(density, 0.1)
    return composite(density, torch.zeros(len(density), 1), step, RAY_START)[2]


def test_light_before_is_what_the_samples_in_front_let_through():
    density = torch.tensor([2.0, 5, 1, 0, 8, 3, 4, 9])
    passed = torch.exp(-0.1 * density)
    light = light_before(weights_of(density), RAY_START)
    expected = torch.ones(8)
    for first, last in zip(RAY_START[:-1].tolist(), RAY_START[1:].tolist(), strict=True):
        for s in range(first + 1, last):
            expected[s] = expected[s - 1] * passed[s - 1]
    torch.testing.assert_close(light, expected, atol=1e-6, rtol=0)


def test_light_before_matches_its_twin():
    weights = weights_of(20 * torch.rand(8, generator=torch.Generator().manual_seed(2)))
    torch.testing.assert_close(light_before(weights, RAY_START), reference.light_before(weights, RAY_START))
    double = light_before(weights.double(), RAY_START)
    torch.testing.assert_close(double.float(), light_before(weights, RAY_START))
