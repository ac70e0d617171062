"""Equal inputs give equal bits where torch adds with several threads."""

import pytest
import torch

from pipeline.kernels.common.determinism import deterministic_sums


@pytest.fixture
def two_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def _gradient() -> torch.Tensor:
    """The gradient of an indexing in which each of 50 rows is the sum of thousands of terms of any size."""
    generator = torch.Generator().manual_seed(0)
    values = torch.randn(50, 3, generator=generator, requires_grad=True)
    rows = torch.randint(50, (200_000,), generator=generator)
    scale = torch.randn(200_000, 3, generator=generator).exp()
    return torch.autograd.grad((values[rows] * scale).sum(), values)[0]


@pytest.mark.usefixtures("two_threads")
def test_gradient_of_indexing_is_repeatable() -> None:
    with deterministic_sums():
        first = _gradient()
        assert all(torch.equal(first, _gradient()) for _ in range(10))


def test_setting_of_the_caller_returns() -> None:
    assert not torch.are_deterministic_algorithms_enabled()
    with deterministic_sums():
        assert torch.are_deterministic_algorithms_enabled()
    assert not torch.are_deterministic_algorithms_enabled()
    assert torch.utils.deterministic.fill_uninitialized_memory
