"""Perspective-correct interpolation of vertex attributes at covered pixels, differentiable."""

from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.kernels.common.dispatch import runs_on_numba
from pipeline.kernels.interpolate.cpu import interpolate_backward, interpolate_forward
from pipeline.kernels.interpolate.reference import interpolate_reference


def interpolate(
    covered: Int[Tensor, "n"],
    face_ids: Int[Tensor, "n"],
    width: int,
    vertices_px: Float[Tensor, "v 2"],
    depth_m: Float[Tensor, "v"],
    faces: Int[Tensor, "f 3"],
    attributes: Float[Tensor, "v c"],
) -> Float[Tensor, "n c"]:
    """Interpolate attributes at pixel centres. Differentiable in vertices_px, depth_m and attributes.

    Args:
        covered: row-major pixel indices in an image of `width` columns.
        face_ids: face visible at each of these pixels.
        vertices_px: image position, pixel centres at +0.5.
        depth_m: > 0 at every corner of the visible faces.
    """
    if not runs_on_numba(vertices_px, depth_m, attributes):
        return interpolate_reference(covered, face_ids, width, vertices_px, depth_m, faces, attributes)
    return _Interpolate.apply(covered, face_ids, width, vertices_px, depth_m, faces.to(torch.int32), attributes)


class _Interpolate(torch.autograd.Function):
    @staticmethod
    def forward(context: Any, covered: Tensor, face_ids: Tensor, width: int, *tensors: Tensor) -> Tensor:
        context.width = width
        context.save_for_backward(covered, face_ids, *tensors)
        arrays = [tensor.detach().contiguous().numpy() for tensor in (covered, face_ids, *tensors)]
        return torch.from_numpy(interpolate_forward(*arrays[:2], width, *arrays[2:]))

    @staticmethod
    def backward(context: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        arrays = [tensor.detach().contiguous().numpy() for tensor in (*context.saved_tensors, gradient)]
        total = torch.from_numpy(interpolate_backward(*arrays[:2], context.width, *arrays[2:]))
        return None, None, None, total[:, :2], total[:, 2], None, total[:, 3:]
