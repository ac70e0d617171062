"""Linear blending of joint values (entries of skinning matrices) at many nodes, by sparse skin weights.

Notation: m nodes, j joints, c columns, e nonzero weights.
"""

from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.kernels.blend import cpu, reference
from pipeline.kernels.common.dispatch import runs_on_numba


class SparseWeights(NamedTuple):
    """The nonzero weights, node after node (CSR); those of node i are row_offsets[i] : row_offsets[i + 1]."""

    row_offsets: Int[Tensor, "m1"]
    joint: Int[Tensor, "e"]
    weight: Float[Tensor, "e"]

    @staticmethod
    def from_dense(weights: Float[Tensor, "m j"]) -> "SparseWeights":
        """Drop the zeros of a dense matrix."""
        node, joint = torch.nonzero(weights, as_tuple=True)
        row_offsets = torch.searchsorted(node, torch.arange(len(weights) + 1, device=node.device))
        return SparseWeights(row_offsets, joint, weights[node, joint])


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, weights: SparseWeights, values: Tensor) -> Tensor:
        blended = values.new_empty(len(weights.row_offsets) - 1, values.shape[1])
        cpu.blend(*(tensor.detach().numpy() for tensor in (*weights, values, blended)))
        ctx.weights, ctx.joints = weights, len(values)
        return blended

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[None, Tensor]:
        weights = (tensor.numpy() for tensor in ctx.weights)
        sums = cpu.blend_backward(*weights, ctx.joints, gradient.contiguous().numpy())
        return None, torch.from_numpy(sums).sum(0)


def blend(weights: SparseWeights, values: Float[Tensor, "j c"]) -> Float[Tensor, "m c"]:
    """Return the weighted sum of joint values at every node; differentiable in `values`.

    >>> blend(SparseWeights.from_dense(torch.tensor([[0.25, 0.75]])), torch.tensor([[1.0, 0.0], [2.0, 4.0]])).tolist()
    [[1.75, 3.0]]
    """
    if not runs_on_numba(weights.weight, values):
        return reference.blend(*weights, values)
    return _Blend.apply(weights, values.contiguous())
