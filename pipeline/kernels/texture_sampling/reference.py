"""Plain-torch reference of texture lookups; differentiable in the texture and in uv."""

import torch
from jaxtyping import Float, Int
from torch import Tensor


def sample_texture_reference(texture: Float[Tensor, "th tw c"], uv: Float[Tensor, "n 2"]) -> Float[Tensor, "n c"]:
    """Look up a texture bilinearly; see `pipeline.geometry.texture_rendering.sample_texture`."""
    grid = torch.stack([2.0 * uv[:, 0] - 1.0, 1.0 - 2.0 * uv[:, 1]], dim=-1)
    sampled = torch.nn.functional.grid_sample(
        texture.permute(2, 0, 1)[None], grid[None, None], mode="bilinear", padding_mode="border", align_corners=False
    )
    return sampled[0, :, 0].T


def supersample_texture_reference(
    face_id: Int[Tensor, "fh fw"],
    barycentric: Float[Tensor, "fh fw 3"],
    faces_uv: Int[Tensor, "f 3"],
    uv: Float[Tensor, "t 2"],
    texture: Float[Tensor, "th tw c"],
    samples: int,
) -> Float[Tensor, "h w c+1"]:
    """Do `pipeline.kernels.texture_sampling.supersample_texture`."""
    height, width = face_id.shape[0] // samples, face_id.shape[1] // samples
    seen = face_id >= 0
    corners_uv = uv[faces_uv.long()[face_id[seen].long()]]
    colour = sample_texture_reference(texture, (barycentric[seen][..., None] * corners_uv).sum(dim=1))
    image = torch.zeros(*face_id.shape, texture.shape[2] + 1, dtype=texture.dtype, device=texture.device)
    image[seen] = torch.cat([colour, torch.ones_like(colour[:, :1])], dim=1)
    return image.view(height, samples, width, samples, -1).mean(dim=(1, 3))


def supersample_attributes_reference(
    face_id: Int[Tensor, "fh fw"],
    barycentric: Float[Tensor, "fh fw 3"],
    faces: Int[Tensor, "f 3"],
    values: Float[Tensor, "v c"],
    samples: int,
) -> Float[Tensor, "h w c"]:
    """Do `pipeline.kernels.texture_sampling.supersample_attributes`."""
    height, width = face_id.shape[0] // samples, face_id.shape[1] // samples
    seen = face_id >= 0
    image = torch.zeros(*face_id.shape, values.shape[1], dtype=values.dtype, device=values.device)
    image[seen] = (values[faces[face_id[seen].long()].long()] * barycentric[seen][..., None]).sum(dim=1)
    total = image.view(height, samples, width, samples, -1).sum(dim=(1, 3))
    covered = seen.view(height, samples, width, samples).sum(dim=(1, 3))
    return total / covered.clamp(min=1)[..., None]
