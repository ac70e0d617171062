"""Depth-tested projective texturing: what one picture says about every texel."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.kernels.common.dispatch import runs_on_numba
from pipeline.kernels.texel_projection.cpu import project_texels_cpu
from pipeline.kernels.texel_projection.reference import project_texels_reference


def project_texels(
    vertices_px: Float[Tensor, "v 2"],
    depth_m: Float[Tensor, "v"],
    cosine: Float[Tensor, "v"],
    faces: Int[Tensor, "f 3"],
    texel_face: Int[Tensor, "t"],
    texel_barycentric: Float[Tensor, "t 3"],
    image: Float[Tensor, "h w c"],
    depth_map_m: Float[Tensor, "h w"],
    pixel_confidence: Float[Tensor, "h w"],
    tolerance_m: float = 0.01,
    min_cosine: float = 0.1,
) -> tuple[Float[Tensor, "t c"], Float[Tensor, "t 2"]]:
    """Bilinear look-ups of a picture at the places where it shows the texels' surface points.

    A texel is visible when nothing in the 2 x 2 pixels that it is read from lies in front of it by more than the
    tolerance (Shetty et al., "Holoported Characters", 2024, supplement B, equation 4, one-sided, and over the whole
    footprint so that no occluder bleeds in).

    Args:
        vertices_px, depth_m: of the posed vertices, as `rasterize` takes them.
        cosine: between each vertex's normal and the direction to the camera.
        texel_face, texel_barycentric: surface point of each texel.
        seen_depth_m: nearest surface in each pixel, inf where there is none.
        quality: trust in each pixel, [0, 1].
        tolerance_m: for surfaces that face the camera; grows with 1 / cosine, as the depth within a pixel does.
        least_cosine: more oblique texels count as invisible.

    Returns values (0 where invisible) and, per texel, (trust, cosine), both 0 where invisible. Not differentiable.
    """
    tensors = (vertices_px, depth_m, cosine, texel_barycentric, image, depth_map_m, pixel_confidence)
    if not runs_on_numba(*tensors):
        return project_texels_reference(
            vertices_px,
            depth_m,
            cosine,
            faces,
            texel_face,
            texel_barycentric,
            image,
            depth_map_m,
            pixel_confidence,
            tolerance_m,
            min_cosine,
        )
    ordered = (vertices_px, depth_m, cosine, faces.int(), texel_face.int(), *tensors[3:])
    arrays = [tensor.detach().contiguous().numpy() for tensor in ordered]
    values, weights = project_texels_cpu(*arrays, tolerance_m, min_cosine)
    return torch.from_numpy(values), torch.from_numpy(weights)
