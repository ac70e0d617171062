"""Edge padding: colours for the texels of an atlas that no chart covers."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

from pipeline.io.image import push_pull


def fill_unknown_texels(
    image: Float[np.ndarray, "h w c"], known: Bool[np.ndarray, "h w"], dilation_px: int = 2
) -> Float32[np.ndarray, "h w c"]:
    """Fill unknown texels, so that bilinear samples and mip levels of known texels do not contain a foreign colour.

    The nearest `dilation_px` rings become the mean of their known neighbours, the rest is filled by push-pull. All
    texels are 0 when none is known.
    """
    colour = np.array(image, dtype=np.float32)
    weight = known.astype(np.float32)
    for _ in range(dilation_px):
        near_weight = cv2.boxFilter(weight, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
        near = cv2.boxFilter(colour * weight[..., None], -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
        new = (weight == 0) & (near_weight > 0.5)
        colour[new] = near.reshape(colour.shape)[new] / near_weight[new][:, None]
        weight[new] = 1.0
    return push_pull(colour, weight > 0)
