import math

import pytest
import torch

from pipeline.kernels.composite import composite, reference

RAY_OFFSETS = torch.tensor([0, 3, 3, 4, 9, 12])


def make(dtype=torch.float32, samples=12, channels=3):
    random = torch.Generator().manual_seed(4)
    density = 30 * torch.rand(samples, generator=random, dtype=dtype)
    colour = torch.rand(samples, channels, generator=random, dtype=dtype)
    step = 0.01 + 0.1 * torch.rand(samples, generator=random, dtype=dtype)
    return density, colour, step


def composite_by_definition(density, colour, step, first, last):
    """One ray, by the definition."""
    transmittance, image, weights = 1.0, [0.0] * colour.shape[1], []
    for i in range(first, last):
        alpha = 1 - math.exp(-float(density[i]) * float(step[i]))
        weights.append(transmittance * alpha)
        image = [old + transmittance * alpha * float(c) for old, c in zip(image, colour[i], strict=True)]
        transmittance *= 1 - alpha
    return image, 1 - transmittance, weights


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_rays_equal_the_compositing_sum(dtype):
    density, colour, step = make(dtype)
    image, alpha, weights = composite(density, colour, step, RAY_OFFSETS)
    for ray in range(5):
        first, last = int(RAY_OFFSETS[ray]), int(RAY_OFFSETS[ray + 1])
        true_image, true_alpha, true_weights = composite_by_definition(density, colour, step, first, last)
        assert image[ray].tolist() == pytest.approx(true_image, abs=2e-6)
        assert float(alpha[ray]) == pytest.approx(true_alpha, abs=2e-6)
        assert weights[first:last].tolist() == pytest.approx(true_weights, abs=2e-6)


def test_uniform_density_matches_the_closed_form():
    count, length, density = 500, 2.0, 0.8
    full = torch.full((count,), density)
    colour, step = torch.full((count, 3), 0.25), torch.full((count,), length / count)
    image, alpha, _ = composite(full, colour, step, torch.tensor([0, count]))
    expected = 1 - math.exp(-density * length)
    assert float(alpha) == pytest.approx(expected, abs=1e-5)
    assert image[0].tolist() == pytest.approx([0.25 * expected] * 3, abs=1e-5)


def test_empty_rays_are_transparent():
    density, colour, step = make()
    image, alpha, _ = composite(density, colour, step, RAY_OFFSETS)
    assert image[1].tolist() == [0, 0, 0]
    assert float(alpha[1]) == 0


def test_gradients_match_reference_in_float64():
    density, colour, step = make()
    inputs = [tensor.clone().requires_grad_(True) for tensor in (density, colour)]
    exact = [tensor.double().requires_grad_(True) for tensor in (density, colour)]
    random = torch.Generator().manual_seed(0)
    to_image, to_alpha = torch.randn(5, 3, generator=random), torch.randn(5, generator=random)
    image, alpha, _ = composite(*inputs, step, RAY_OFFSETS)
    ((image * to_image).sum() + (alpha * to_alpha).sum()).backward()
    image, alpha, _ = composite(*exact, step.double(), RAY_OFFSETS)
    ((image * to_image.double()).sum() + (alpha * to_alpha.double()).sum()).backward()
    for ours, expected in zip(inputs, exact, strict=True):
        torch.testing.assert_close(ours.grad.double(), expected.grad, atol=1e-6, rtol=1e-5)


def test_reference_passes_gradcheck():
    density, colour, step = make(torch.float64)
    assert torch.autograd.gradcheck(
        lambda d, c: reference.composite(d, c, step, RAY_OFFSETS)[:2],
        (density.requires_grad_(True), colour.requires_grad_(True)),
    )


def test_float32_reference_is_accurate_after_many_opaque_rays():
    """On a GPU the reference runs in float32, with all rays of a step at once."""
    density = torch.cat([torch.full((50_000,), 1e4), torch.tensor([0.3, 0.2, 0.1])])
    step, colour, ray_offsets = torch.full_like(density, 0.02), torch.ones(50_003, 1), torch.tensor([0, 50_000, 50_003])
    _, alpha, weights = reference.composite(density, colour, step, ray_offsets)
    assert float(alpha[1]) == pytest.approx(1 - math.exp(-0.6 * 0.02), rel=1e-4)
    assert weights[-1].item() == pytest.approx(math.exp(-0.5 * 0.02) * (1 - math.exp(-0.1 * 0.02)), rel=1e-4)
