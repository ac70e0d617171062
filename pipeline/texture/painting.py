"""Paint over the diffuse map of a finished texture: from an image in its layout, or with colours of its texels."""

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from pipeline.core.errors import UserError
from pipeline.geometry.atlas import rasterize_texels
from pipeline.io.image import read_alpha, read_gray, read_rgb_float, to_float, to_uint8
from pipeline.texture.edge_padding import fill_unknown_texels
from pipeline.texture.files import TextureArtifact

MIN_SIDE_PX, MAX_SIDE_PX = 256, 8192
"""Sides of a painted map: charts of a body in fewer texels run into each other, more are larger than GPUs take."""


@dataclass(frozen=True)
class Painting:
    """An image in the layout of a diffuse map.

    Attributes:
        colour: sRGB in [0, 1].
        alpha: where it applies, in [0, 1].
    """

    colour: Float[np.ndarray, "s s 3"]
    alpha: Float[np.ndarray, "s s"]


def read_painting(path: Path) -> Painting:
    """Read a painted diffuse map; without an alpha channel it applies everywhere.

    Raises:
        UserError: the file cannot be read, or is not a square of `MIN_SIDE_PX` to `MAX_SIDE_PX`.
    """
    colour = read_rgb_float(path)
    _check_layout(path, colour)
    alpha = to_float(read_alpha(path))
    if alpha.shape != colour.shape[:2] or not alpha.any():
        raise UserError(f"image {path} is transparent everywhere; paint on it, or remove its alpha channel")
    return Painting(np.clip(colour, 0.0, 1.0), alpha)


def read_mask(path: Path) -> Float[np.ndarray, "s s"]:
    """Read a mask in the layout of a diffuse map: 1 (white) replaces, grey blends, transparent keeps.

    Raises:
        UserError: the file cannot be read, is not a square of `MIN_SIDE_PX` to `MAX_SIDE_PX`, or is black.
    """
    mask = to_float(read_gray(path))
    _check_layout(path, mask)
    mask = mask * to_float(read_alpha(path))
    if not mask.any():
        raise UserError(f"mask {path} is black or transparent everywhere; paint what is replaced white")
    return mask


def resize_map(values: Float[np.ndarray, "h w *c"], side_px: int) -> Float[np.ndarray, "s s *c"]:
    """Resample a square map: mean of the area where it shrinks, linear where it grows."""
    if len(values) == side_px:
        return values
    kind = cv2.INTER_AREA if side_px < len(values) else cv2.INTER_LINEAR
    return cv2.resize(np.ascontiguousarray(values, np.float32), (side_px, side_px), interpolation=kind)


def enlarge_maps(texture: TextureArtifact, side_px: int) -> TextureArtifact:
    """Return the texture with maps of at least that side."""
    side_px = max(side_px, len(texture.diffuse))
    return replace(
        texture,
        diffuse=resize_map(texture.diffuse, side_px),
        specular=resize_map(texture.specular, side_px),
        roughness=None if texture.roughness is None else resize_map(texture.roughness, side_px),
        coverage=to_uint8(resize_map(to_float(texture.coverage), side_px)),
    )


def paint_over(texture: TextureArtifact, painting: Painting) -> TextureArtifact:
    """Return the texture with a painting blended over its diffuse map, of the larger of the two sizes.

    The gutters between the charts are filled anew from the charts, whatever the painting has there.
    """
    texture = enlarge_maps(texture, len(painting.colour))
    side_px = len(texture.diffuse)
    # Colour under alpha 0 is no paint: it must not enter the mean of its neighbours.
    alpha = resize_map(painting.alpha, side_px)[..., None]
    premultiplied = resize_map(painting.colour * painting.alpha[..., None], side_px)
    return replace_diffuse(texture, premultiplied + (1.0 - alpha) * texture.diffuse)


def replace_diffuse(texture: TextureArtifact, diffuse: Float[np.ndarray, "s s 3"]) -> TextureArtifact:
    """Return the texture with another diffuse map of its size, whose gutters are filled from the charts."""
    known = rasterize_texels(texture.atlas, len(diffuse)).coverage_mask()
    filled = fill_unknown_texels(np.clip(diffuse, 0.0, 1.0), known)
    return replace(texture, diffuse=np.ascontiguousarray(filled, np.float32))


def _check_layout(path: Path, pixels: np.ndarray) -> None:
    height, width = pixels.shape[:2]
    if height != width or not MIN_SIDE_PX <= width <= MAX_SIDE_PX:
        raise UserError(
            f"image {path} has {width} x {height} px; paint on a copy of texture/diffuse.png, square, "
            f"{MIN_SIDE_PX} to {MAX_SIDE_PX} px"
        )
