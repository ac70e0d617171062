"""Blending of what joints hold (entries of skinning matrices) at many nodes, by skin weights that are mostly zero.

Letters: m nodes, j joints, c columns, e weights that are not zero.
"""

from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.kernels.blend import cpu as blend_cpu
from pipeline.kernels.blend import reference
from pipeline.kernels.common.dispatch import runs_on_numba


class SparseWeights(NamedTuple):
    """The weights that are not zero, node after node; those of node i are row_start[i] : row_start[i + 1]."""

    row_offsets: Int[Tensor, "m1"]
    joint: Int[Tensor, "e"]
    weight: Float[Tensor, "e"]

    @staticmethod
    def of(weights: Float[Tensor, "m j"]) -> "SparseWeights":
        """Without the zeros."""
        node, joint = torch.nonzero(weights, as_tuple=True)
        row_offsets = torch.searchsorted(node, torch.arange(len(weights) + 1, device=node.device))
        return SparseWeights(row_offsets, joint, weights[node, joint])


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, weights: SparseWeights, values: Tensor) -> Tensor:
        blended = values.new_empty(len(weights.row_offsets) - 1, values.shape[1])
        arrays = (tensor.detach().numpy() for tensor in (*weights, values, blended))
        blend_cpu.blend(*arrays)
        ctx.weights, ctx.joints = weights, len(values)
        return blended

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[None, Tensor]:
        weights = (tensor.numpy() for tensor in ctx.weights)
        sums = blend_cpu.blend_backward(*weights, ctx.joints, gradient.contiguous().numpy())
        return None, torch.from_numpy(sums).sum(0)


def blend(weights: SparseWeights, values: Float[Tensor, "j c"]) -> Float[Tensor, "m c"]:
    """At every node the weighted sum of its joints' values; differentiable in the values.

    >>> blend(SparseWeights.of(torch.tensor([[0.25, 0.75]])), torch.tensor([[1.0, 0.0], [2.0, 4.0]])).tolist()
    [[1.75, 3.0]]
    """
    if not runs_on_numba(weights.weight, values):
        return reference.blend(*weights, values)
    return _Blend.apply(weights, values.contiguous())
