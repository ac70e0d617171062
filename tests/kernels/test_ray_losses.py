"""Losses of rays: closed forms, and the compiled loop against the reference in float64."""

import math

import pytest
import torch

from pipeline.kernels.ray_losses import ray_losses, reference
from pipeline.kernels.ray_losses.reference import colour_errors, hard_surface, huber


def test_huber_is_square_then_linear():
    values = huber(torch.tensor([0.0, 0.05, -0.05, 1.0, -3.0]), 0.1)
    assert values.tolist() == pytest.approx([0, 0.0125, 0.0125, 0.95, 2.95])


def test_hard_surface_is_zero_at_both_ends_and_largest_between():
    alpha = torch.linspace(0, 1, 101)
    values = hard_surface(alpha)
    assert float(values[0]) == pytest.approx(0, abs=1e-6)
    assert float(values[100]) == pytest.approx(0, abs=1e-6)
    assert int(values.argmax()) == 50
    assert float(values[50]) == pytest.approx(math.log(1 + math.exp(-1)) - math.log(2 * math.exp(-0.5)), abs=1e-6)


def test_colour_errors_of_perfect_and_transparent_images():
    rgba = torch.tensor([[0.2, 0.4, 0.6, 1.0], [0.9, 0.1, 0.5, 0.25]])
    background = torch.tensor([[1.0, 0.0, 0.5], [0.3, 0.3, 0.3]])
    perfect = rgba[:, :3] * rgba[:, 3:]
    assert colour_errors(perfect, rgba[:, 3], rgba, background).abs().max() < 1e-7
    hole = colour_errors(torch.zeros(2, 3), torch.zeros(2), rgba, background)
    torch.testing.assert_close(hole[0], torch.tensor([0.8, -0.4, -0.1]))
    torch.testing.assert_close(hole[1], 0.25 * torch.tensor([-0.6, 0.2, -0.2]))


def losses_and_gradients(rays, delta, dtype, implementation):
    """Losses, errors, and gradients of a sum with a different weight for each loss."""
    random = torch.Generator().manual_seed(rays)
    image, alpha, rgba, background, confidence = (
        torch.rand(shape, generator=random) for shape in ((rays, 3), rays, (rays, 4), (rays, 3), rays)
    )
    alpha = 1.4 * alpha - 0.2
    rgba[::3, 3] = (rgba[::3, 3] > 0.5).float()
    image, alpha, rgba, background, confidence = (
        tensor.to(dtype) for tensor in (image, alpha, rgba, background, confidence)
    )
    image.requires_grad_(), alpha.requires_grad_()
    losses, errors = implementation(image, alpha, rgba, background, confidence, delta)
    gradients = torch.autograd.grad((losses * torch.tensor([1.0, 0.3, 0.2], dtype=dtype)).sum(), [image, alpha])
    return losses.detach(), errors, *gradients


@pytest.mark.parametrize("rays", [1, 700])
@pytest.mark.parametrize("delta", [0.05, 0.3, 1.0])
def test_compiled_losses_match_reference(rays, delta):
    ours = losses_and_gradients(rays, delta, torch.float32, ray_losses)
    expected = losses_and_gradients(rays, delta, torch.float64, reference.ray_losses)
    for mine, theirs in zip(ours, expected, strict=True):
        torch.testing.assert_close(mine.double(), theirs, rtol=2e-5, atol=2e-7)
    assert not ours[1].requires_grad


def test_losses_are_weighted_by_confidence():
    random = torch.Generator().manual_seed(0)
    image, alpha, rgba, background = (torch.rand(shape, generator=random) for shape in ((4, 3), 4, (4, 4), (4, 3)))
    confidence = torch.tensor([1.0, 0.0, 0.25, 0.0])
    losses, _ = ray_losses(image, alpha, rgba, background, confidence, 0.1)
    each = [ray_losses(image[[i]], alpha[[i]], rgba[[i]], background[[i]], torch.ones(1), 0.1)[0] for i in (0, 2)]
    torch.testing.assert_close(losses, (each[0] + 0.25 * each[1]) / 4)


def test_float64_uses_the_reference():
    ours = losses_and_gradients(9, 0.3, torch.float64, ray_losses)
    for mine, theirs in zip(ours, losses_and_gradients(9, 0.3, torch.float64, reference.ray_losses), strict=True):
        assert torch.equal(mine, theirs)
