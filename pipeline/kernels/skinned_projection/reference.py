"""Plain-torch reference of the projection of skinned vertices: any dtype, any device, gradients by autograd."""

import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.kernels.blend import SparseWeights
from pipeline.kernels.blend.reference import blend


def project_skinned(
    vertices: Float[Tensor, "v 3"],
    weights: SparseWeights,
    matrices: Float[Tensor, "j 12"],
    intrinsics_px: tuple[float, float, float, float],
) -> tuple[Float[Tensor, "v 2"], Float[Tensor, "v"]]:
    """Do `pipeline.kernels.skinned_projection.project_skinned`, with the first three rows of the matrices."""
    blended = blend(*weights, matrices.to(vertices)).view(-1, 3, 4)
    x, y, depth_m = ((blended[..., :3] @ vertices[:, :, None]).squeeze(-1) + blended[..., 3]).unbind(-1)
    fx, fy, cx, cy = intrinsics_px
    return torch.stack([fx * x / depth_m + cx, fy * y / depth_m + cy], dim=-1), depth_m
