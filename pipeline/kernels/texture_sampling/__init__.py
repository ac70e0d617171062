"""Lookup of textures and of vertex attributes at rasterised points, averaged over the subsamples of each pixel."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.kernels.common.dispatch import runs_on_numba
from pipeline.kernels.texture_sampling.cpu import supersample_attributes_cpu, supersample_texture_cpu
from pipeline.kernels.texture_sampling.reference import supersample_attributes_reference, supersample_texture_reference


def supersample_texture(
    face_id: Int[Tensor, "fh fw"],
    barycentric: Float[Tensor, "fh fw 3"],
    faces_uv: Int[Tensor, "f 3"],
    uv: Float[Tensor, "t 2"],
    texture: Float[Tensor, "th tw c"],
    samples: int,
) -> Float[Tensor, "h w c+1"]:
    """Return the premultiplied colour and the coverage of pixels with `samples` x `samples` rasterised points each.

    Args:
        face_id: visible face, -1 for none, from `rasterize` at `samples` times the size of the output.
        barycentric: from the same call.
        uv: origin bottom-left; row 0 of the texture is at v = 1; texel centres at +0.5; clamped to the border.

    The compiled loop has no gradient; if an input requires one, the reference runs.
    """
    tensors = (barycentric, uv, texture)
    if any(tensor.requires_grad for tensor in tensors) or not runs_on_numba(*tensors):
        return supersample_texture_reference(face_id, barycentric, faces_uv, uv, texture, samples)
    ordered = (face_id.int(), barycentric, faces_uv.int(), uv, texture)
    return torch.from_numpy(supersample_texture_cpu(*(tensor.contiguous().numpy() for tensor in ordered), samples))


def supersample_attributes(
    face_id: Int[Tensor, "fh fw"],
    barycentric: Float[Tensor, "fh fw 3"],
    faces: Int[Tensor, "f 3"],
    values: Float[Tensor, "v c"],
    samples: int,
) -> Float[Tensor, "h w c"]:
    """Return the mean of interpolated values of vertices over the covered points of each pixel; 0 without any.

    Args:
        face_id: visible face, -1 for none, from `rasterize` at `samples` times the size of the output.
        barycentric: from the same call.
        faces: corners of each face. values: of each vertex.

    The compiled loop has no gradient; if an input requires one, the reference runs.
    """
    if values.requires_grad or barycentric.requires_grad or not runs_on_numba(barycentric, values):
        return supersample_attributes_reference(face_id, barycentric, faces, values, samples)
    ordered = (face_id.int(), barycentric, faces.int(), values)
    return torch.from_numpy(supersample_attributes_cpu(*(tensor.contiguous().numpy() for tensor in ordered), samples))
