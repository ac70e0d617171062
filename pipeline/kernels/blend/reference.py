"""Plain-torch reference of blending: any dtype, any device, gradients by autograd."""

from jaxtyping import Float, Int
from torch import Tensor

from pipeline.kernels.common.packing import segment_ids_from_counts


def blend(
    row_offsets: Int[Tensor, "m1"], joint: Int[Tensor, "e"], weight: Float[Tensor, "e"], values: Float[Tensor, "j c"]
) -> Float[Tensor, "m c"]:
    """Do `pipeline.kernels.blend.blend`, with the fields of `SparseWeights`."""
    node = segment_ids_from_counts(row_offsets.diff())
    blended = values.new_zeros(len(row_offsets) - 1, values.shape[1])
    return blended.index_add(0, node, weight.to(values)[:, None] * values.index_select(0, joint))
