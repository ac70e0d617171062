"""The texture's colours at what a rasteriser saw, averaged over the samples of a pixel."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.kernels.common.dispatch import runs_on_numba
from pipeline.kernels.texture_sampling.cpu import supersample_texture_cpu
from pipeline.kernels.texture_sampling.reference import supersample_texture_reference


def supersample_texture(
    face_id: Int[Tensor, "fh fw"],
    barycentric: Float[Tensor, "fh fw 3"],
    faces_uv: Int[Tensor, "f 3"],
    uv: Float[Tensor, "t 2"],
    texture: Float[Tensor, "th tw c"],
    samples: int,
) -> Float[Tensor, "h w c+1"]:
    """Premultiplied colour and coverage of pixels of `samples` x `samples` rasterised points each.

    face_id (-1 none), barycentric: from ``rasterize`` at `samples` times the size, both sides multiples of `samples`.
    uv: origin bottom-left, row 0 of the texture at v = 1, texel centres at +0.5, the border repeated outside of [0, 1].

    The fast path has no gradient; where one is asked for, the plain twin runs.
    """
    tensors = (barycentric, uv, texture)
    if any(tensor.requires_grad for tensor in tensors) or not runs_on_numba(*tensors):
        return supersample_texture_reference(face_id, barycentric, faces_uv, uv, texture, samples)
    ordered = (face_id.int(), barycentric, faces_uv.int(), uv, texture)
    return torch.from_numpy(supersample_texture_cpu(*(tensor.contiguous().numpy() for tensor in ordered), samples))
