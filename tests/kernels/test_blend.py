import pytest
import torch

from pipeline.kernels.blend import SparseWeights, blend


def dense_weights():
    """100 nodes with three joints and one without: 101 is no multiple of the number of parts of the backward pass."""
    random = torch.Generator().manual_seed(3)
    weights = torch.rand(101, 9, generator=random, dtype=torch.float64)
    weights[weights < weights.topk(3).values[:, -1:]] = 0
    weights[-1] = 0
    return weights


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_values_and_gradients_equal_the_dense_product(dtype):
    weights, random = dense_weights(), torch.Generator().manual_seed(4)
    values = torch.randn(9, 24, generator=random, dtype=torch.float64)
    grad_output = torch.randn(101, 24, generator=random, dtype=torch.float64)
    leaf = values.to(dtype).requires_grad_(True)
    blended = blend(SparseWeights.from_dense(weights.to(dtype)), leaf)
    (blended * grad_output.to(dtype)).sum().backward()
    tolerance = {"atol": 1e-5, "rtol": 1e-5} if dtype == torch.float32 else {"atol": 1e-12, "rtol": 0}
    torch.testing.assert_close(blended.detach().double(), weights @ values, **tolerance)
    torch.testing.assert_close(leaf.grad.double(), weights.T @ grad_output, **tolerance)


def test_sparse_weights_contain_all_nonzeros():
    weights = dense_weights()
    row_offsets, joint, weight = SparseWeights.from_dense(weights)
    assert row_offsets.diff().tolist() == [3] * 100 + [0]
    back = torch.zeros_like(weights)
    back[torch.repeat_interleave(torch.arange(101), row_offsets.diff()), joint] = weight
    assert torch.equal(back, weights)
