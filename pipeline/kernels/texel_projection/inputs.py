"""Inputs of projective texturing. Notation: v vertices, f faces, t texels, h x w pixels, c channels."""

from typing import NamedTuple

from jaxtyping import Float, Int
from torch import Tensor


class ProjectedMesh(NamedTuple):
    """A posed mesh in an image: vertices and depth as for `rasterize`.

    cosine: of the angle between the normal of each vertex and the direction to the camera.
    """

    vertices_px: Float[Tensor, "v 2"]
    depth_m: Float[Tensor, "v"]
    cosine: Float[Tensor, "v"]
    faces: Int[Tensor, "f 3"]


class TexelPoints(NamedTuple):
    """Surface point of each texel: its face, and its barycentrics in the face."""

    face: Int[Tensor, "t"]
    barycentric: Float[Tensor, "t 3"]


class ImageView(NamedTuple):
    """An image, the depth of the nearest surface at each pixel (inf for none), and a confidence in [0, 1]."""

    image: Float[Tensor, "h w c"]
    depth_map_m: Float[Tensor, "h w"]
    pixel_confidence: Float[Tensor, "h w"]


class ProjectionWeights(NamedTuple):
    """Weight of a texel in a view: `view_weight` * confidence * cosine^`cosine_power`; 0 where it is invisible.

    tolerance_m, min_cosine: when a texel is visible, see `project_texels`.
    """

    view_weight: float
    cosine_power: float
    tolerance_m: float = 0.01
    min_cosine: float = 0.1


class TexelSums(NamedTuple):
    """Sums over views at each texel: of weighted values, and of their weights."""

    values: Float[Tensor, "t c"]
    weight: Float[Tensor, "t"]
