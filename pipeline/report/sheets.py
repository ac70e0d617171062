"""Contact sheets: several images in one."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8

GAP_PX = 8


def composite_on_white_uint8(image: UInt8[np.ndarray, "h w 4"]) -> UInt8[np.ndarray, "h w 3"]:
    """Composite an image with straight alpha on white."""
    alpha = image[..., 3:].astype(np.float32) / 255.0
    return np.rint(image[..., :3] * alpha + 255.0 * (1.0 - alpha)).astype(np.uint8)


def image_grid(rows: Sequence[Sequence[UInt8[np.ndarray, "_ _ 3"]]]) -> UInt8[np.ndarray, "h w 3"]:
    """Arrange rows of images of any size on white; images are aligned to the top of their row.

    Raises:
        ValueError: there is no image.
    """
    if not any(rows):
        raise ValueError("a sheet needs at least one image")
    filled = [row for row in rows if row]
    width = max(sum(image.shape[1] + GAP_PX for image in row) for row in filled) + GAP_PX
    height = sum(max(image.shape[0] for image in row) + GAP_PX for row in filled) + GAP_PX
    sheet = np.full((height, width, 3), 255, dtype=np.uint8)
    top = GAP_PX
    for row in filled:
        left = GAP_PX
        for image in row:
            sheet[top : top + image.shape[0], left : left + image.shape[1]] = image
            left += image.shape[1] + GAP_PX
        top += max(image.shape[0] for image in row) + GAP_PX
    return sheet
