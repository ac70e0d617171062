import pytest
import torch

from pipeline.kernels.adam import adam_step_


def run(dtype, steps=7, shape=(37, 3)):
    random = torch.Generator().manual_seed(3)
    ours = torch.randn(shape, generator=random).to(dtype)
    theirs = ours.clone().requires_grad_(True)
    optimiser = torch.optim.Adam([theirs], lr=0.02, betas=(0.9, 0.99), eps=1e-15)
    first, second, gradient = torch.zeros_like(ours), torch.zeros_like(ours), torch.zeros_like(ours)
    for step in range(1, steps + 1):
        new = torch.randn(shape, generator=random).to(dtype)
        gradient.copy_(new)
        theirs.grad = new
        adam_step_(ours, gradient, first, second, step, 0.02)
        optimiser.step()
        assert not gradient.any()
    return ours, theirs.detach()


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-6), (torch.float64, 1e-12)])
def test_steps_equal_torch_adam(dtype, tolerance):
    ours, theirs = run(dtype)
    torch.testing.assert_close(ours, theirs, atol=tolerance, rtol=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_non_finite_gradients_are_ignored(dtype, bad):
    parameter, first, second = torch.ones(4, dtype=dtype), torch.zeros(4, dtype=dtype), torch.zeros(4, dtype=dtype)
    gradient = torch.tensor([1.0, bad, 0.0, -1.0], dtype=dtype)
    adam_step_(parameter, gradient, first, second, 1, 0.1)
    assert parameter.tolist() == pytest.approx([0.9, 1.0, 1.0, 1.1])
    assert torch.isfinite(first).all()
    assert torch.isfinite(second).all()


def test_moments_do_not_stay_denormal():
    parameter, gradient = torch.zeros(1), torch.full((1,), 1e-12)
    first, second = torch.full((1,), 1e-29), torch.full((1,), 1e-29)
    for step in range(1, 400):
        gradient.zero_()
        adam_step_(parameter, gradient, first, second, step, 0.1)
    assert float(first) == 0
    assert float(second) < 1.2e-30


def test_mismatched_tensors_are_rejected():
    with pytest.raises(ValueError, match="contiguous"):
        adam_step_(torch.zeros(3), torch.zeros(4), torch.zeros(3), torch.zeros(3), 1, 0.1)
