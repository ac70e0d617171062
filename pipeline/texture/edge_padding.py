"""Edge padding: colours for the texels of an atlas that no chart covers."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

from pipeline.io.image import push_pull

DILATION_PX = 2
"""Rings around known texels that become the mean of their known neighbours."""


def fill_unknown_texels(
    image: Float[np.ndarray, "h w c"], known: Bool[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w c"]:
    """Fill unknown texels, so that bilinear samples and mip levels of known texels do not contain a foreign colour.

    The nearest `DILATION_PX` rings become the mean of their known neighbours, the rest is filled by push-pull. All
    texels are 0 when none is known.
    """
    return push_pull(*_dilated(image, known))


def dilate_known_texels(
    image: Float[np.ndarray, "h w c"], known: Bool[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w c"]:
    """Fill the nearest `DILATION_PX` rings of unknown texels only: enough for bilinear samples without mip levels.

    Unknown texels beyond are 0.
    """
    return _dilated(image, known)[0]


def _dilated(
    image: Float[np.ndarray, "h w c"], known: Bool[np.ndarray, "h w"]
) -> tuple[Float32[np.ndarray, "h w c"], Bool[np.ndarray, "h w"]]:
    """Return the image with `DILATION_PX` rings filled, and which texels are known then."""
    colour = np.where(known[..., None], image, np.float32(0.0)).astype(np.float32, copy=False)
    weight = known.astype(np.float32)
    for _ in range(DILATION_PX):
        near_weight = cv2.boxFilter(weight, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
        near = cv2.boxFilter(colour, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
        new = (weight == 0) & (near_weight > 0.5)
        colour[new] = near.reshape(colour.shape)[new] / near_weight[new][:, None]
        weight[new] = 1.0
    return colour, weight > 0
