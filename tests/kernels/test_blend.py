import pytest
import torch

from pipeline.kernels.blend import SparseWeights, blend


def dense_weights():
    """Of 100 nodes three joints count, of the last none: no multiple of the parts that the nodes are shared out in."""
    random = torch.Generator().manual_seed(3)
    weights = torch.rand(101, 9, generator=random, dtype=torch.float64)
    weights[weights < weights.topk(3).values[:, -1:]] = 0
    weights[-1] = 0
    return weights


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_it_is_the_dense_product_in_value_and_gradient(dtype):
    weights, random = dense_weights(), torch.Generator().manual_seed(4)
    values = torch.randn(9, 24, generator=random, dtype=torch.float64)
    towards = torch.randn(101, 24, generator=random, dtype=torch.float64)
    leaf = values.to(dtype).requires_grad_(True)
    blended = blend(SparseWeights.of(weights.to(dtype)), leaf)
    (blended * towards.to(dtype)).sum().backward()
    tolerance = {"atol": 1e-5, "rtol": 1e-5} if dtype == torch.float32 else {"atol": 1e-12, "rtol": 0}
    torch.testing.assert_close(blended.detach().double(), weights @ values, **tolerance)
    torch.testing.assert_close(leaf.grad.double(), weights.T @ towards, **tolerance)


def test_sparse_weights_leave_out_the_zeros_alone():
    weights = dense_weights()
    row_start, joint, weight = SparseWeights.of(weights)
    assert row_start.diff().tolist() == [3] * 100 + [0]
    back = torch.zeros_like(weights)
    back[torch.repeat_interleave(torch.arange(101), row_start.diff()), joint] = weight
    assert torch.equal(back, weights)
