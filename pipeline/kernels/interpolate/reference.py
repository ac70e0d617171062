"""Plain-torch reference of interpolation: any dtype, any device, gradients by autograd."""

from jaxtyping import Float, Int
from torch import Tensor

from pipeline.kernels.raster.reference import pixel_centres_px, weighted_inverse_depth


def interpolate_reference(
    covered: Int[Tensor, "n"],
    face_ids: Int[Tensor, "n"],
    width: int,
    vertices_px: Float[Tensor, "v 2"],
    depth_m: Float[Tensor, "v"],
    faces: Int[Tensor, "f 3"],
    attributes: Float[Tensor, "v c"],
) -> Float[Tensor, "n c"]:
    """Do `pipeline.kernels.interpolate.interpolate`."""
    corner = faces.long()[face_ids.long()]
    centres = pixel_centres_px(covered, width, vertices_px.dtype)
    q = weighted_inverse_depth(vertices_px[corner], depth_m[corner], centres)
    return ((q / q.sum(1, keepdim=True))[..., None] * attributes[corner]).sum(1)
