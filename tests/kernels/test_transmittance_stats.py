import torch

from pipeline.kernels.composite import composite
from pipeline.kernels.transmittance_stats import reference, transmittance_from_weights

RAY_OFFSETS = torch.tensor([0, 3, 3, 7, 8])


def weights_of(density):
    step = torch.full_like(density, 0.1)
    return composite(density, torch.zeros(len(density), 1), step, RAY_OFFSETS)[2]


def test_transmittance_is_the_product_of_segment_transmittances():
    density = torch.tensor([2.0, 5, 1, 0, 8, 3, 4, 9])
    segment_transmittance = torch.exp(-0.1 * density)
    transmittance = transmittance_from_weights(weights_of(density), RAY_OFFSETS)
    expected = torch.ones(8)
    for first, last in zip(RAY_OFFSETS[:-1].tolist(), RAY_OFFSETS[1:].tolist(), strict=True):
        for s in range(first + 1, last):
            expected[s] = expected[s - 1] * segment_transmittance[s - 1]
    torch.testing.assert_close(transmittance, expected, atol=1e-6, rtol=0)


def test_transmittance_matches_reference():
    weights = weights_of(20 * torch.rand(8, generator=torch.Generator().manual_seed(2)))
    torch.testing.assert_close(
        transmittance_from_weights(weights, RAY_OFFSETS), reference.transmittance_from_weights(weights, RAY_OFFSETS)
    )
    double = transmittance_from_weights(weights.double(), RAY_OFFSETS)
    torch.testing.assert_close(double.float(), transmittance_from_weights(weights, RAY_OFFSETS))
