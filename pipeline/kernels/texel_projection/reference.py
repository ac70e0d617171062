"""Plain-torch reference of projective texturing: any dtype, any device."""

import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.kernels.texel_projection.inputs import (
    ImageView,
    ProjectedMesh,
    ProjectionWeights,
    TexelPoints,
    TexelSums,
)


def project_texels(
    mesh: ProjectedMesh, texels: TexelPoints, view: ImageView, tolerance_m: float, min_cosine: float
) -> tuple[Float[Tensor, "t c"], Float[Tensor, "t 2"]]:
    """Do `pipeline.kernels.texel_projection.project_texels`."""
    vertices_px, depth_m, cosine, faces = mesh
    texel_face, texel_barycentric = texels
    image, depth_map_m, pixel_confidence = view
    height, width = pixel_confidence.shape
    corners = faces.long()[texel_face.long()]
    texel_cosine = (texel_barycentric * cosine[corners]).sum(dim=1)
    corner_depth = texel_barycentric * depth_m[corners]
    z = corner_depth.sum(dim=1)
    position = (corner_depth[..., None] * vertices_px[corners]).sum(dim=1) / z[:, None] - 0.5
    limit = position.new_tensor([width - 1, height - 1])
    possible = (texel_cosine > min_cosine) & (z > 0) & (position >= 0).all(dim=1) & (position < limit).all(dim=1)

    position = torch.where(possible[:, None], position, 0.0)
    first = position.floor().long()
    right, down = (position - first).unbind(dim=1)
    weights = torch.stack([(1 - right) * (1 - down), right * (1 - down), (1 - right) * down, right * down], dim=1)
    rows = torch.clamp(first[:, 1:] + torch.tensor([0, 0, 1, 1], device=first.device), max=height - 1)
    columns = torch.clamp(first[:, :1] + torch.tensor([0, 1, 0, 1], device=first.device), max=width - 1)
    nearest = depth_map_m[rows, columns].amin(dim=1)
    visible = possible & (nearest >= z - tolerance_m / torch.where(possible, texel_cosine, 1.0))
    values = (weights[..., None] * image[rows, columns]).sum(dim=1)
    confidence = (weights * pixel_confidence[rows, columns]).sum(dim=1)
    confidence_and_cosine = torch.stack([confidence, texel_cosine], dim=1)
    return torch.where(visible[:, None], values, 0.0), torch.where(visible[:, None], confidence_and_cosine, 0.0)


def add_projections_(
    sums: TexelSums, mesh: ProjectedMesh, texels: TexelPoints, view: ImageView, weighting: ProjectionWeights
) -> None:
    """Do `pipeline.kernels.texel_projection.add_projections_`."""
    values, seen = project_texels(mesh, texels, view, weighting.tolerance_m, weighting.min_cosine)
    weight = seen[:, 0] * seen[:, 1] ** weighting.cosine_power * weighting.view_weight
    sums.values.addcmul_(values, weight[:, None])
    sums.weight.add_(weight)
