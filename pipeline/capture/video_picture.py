"""A decoded picture of a video as a viewer shows it: colours, fields, pixel aspect ratio and orientation."""

from collections.abc import Callable
from fractions import Fraction
from functools import partial
from typing import cast

import av
import cv2
import numpy as np
from av.sidedata.sidedata import SideData
from jaxtyping import Int32, Shaped

from pipeline.io import hdr

# Bicubic, with chroma brought to full resolution before the colour matrix: swscale's default repeats each chroma
# sample over 2 x 2 pixels, which leaves visible blocks along the person's outline (bits of libswscale's SWS_* flags).
_SWS_FLAGS = 0x4 | 0x2000 | 0x4000 | 0x40000
_UNSPECIFIED_MATRIX = 2
"""Code of a file without matrix coefficients (ITU-T H.273, table 4)."""
_SWS_BT_709, _SWS_BT_2020 = 1, 9
_HD_MIN_WIDTH_PX, _SD_MAX_HEIGHT_PX = 1280, 576
_YUV_FORMATS = ("yuv", "yuy", "uyvy", "nv", "p0")
"""How FFmpeg's names of formats of luma and chroma begin; those with yuvj are JPEG's, whose matrix is BT.601."""

DecodedImage = tuple[np.ndarray, Callable[[np.ndarray], np.ndarray]]
"""An image (8-bit sRGB, or 16 bits with another transfer function) and its conversion to 8-bit sRGB."""


def read_display_matrix(picture: av.VideoFrame) -> Int32[np.ndarray, "9"] | None:
    """Return the display matrix of a decoded frame, see `orient`; None if the container has none.

    To be read once for a video: a frame and its side data refer to each other, and stay in memory until the garbage
    collector finds them.
    """
    data = cast(SideData | None, picture.side_data.get("DISPLAYMATRIX"))  # PyAV's stubs lack it
    return None if data is None else np.frombuffer(bytes(data), np.int32)


def to_upright_rgb(
    picture: av.VideoFrame, aspect: Fraction | None, display_matrix: Int32[np.ndarray, "9"] | None = None
) -> DecodedImage:
    """Return the RGB image of a decoded frame with square pixels, turned and mirrored as the container says.

    aspect: width of a pixel divided by its height; None: 1. display_matrix: see `orient`; None: upright. The picture of
    an interlaced frame is its first field.
    """
    transfer, primaries = int(picture.color_trc), int(picture.color_primaries)
    is_hdr = transfer in hdr.HDR_TRANSFERS
    if picture.interlaced_frame:
        _deinterlace(picture)
    pixels = picture.reformat(
        format="rgb48le" if is_hdr else "rgb24", src_colorspace=_missing_matrix(picture), interpolation=_SWS_FLAGS
    )
    rgb: np.ndarray = pixels.to_ndarray()
    if aspect and aspect != 1:
        rgb = cv2.resize(rgb, (round(rgb.shape[1] * aspect), rgb.shape[0]), interpolation=cv2.INTER_CUBIC)
    to_srgb = partial(hdr.to_srgb, transfer=transfer, primaries=primaries) if is_hdr else np.asarray
    if display_matrix is not None:
        rgb = orient(rgb, display_matrix)
    return np.ascontiguousarray(rgb), to_srgb


def orient(pixels: Shaped[np.ndarray, "h w c"], display_matrix: Int32[np.ndarray, "9"]) -> np.ndarray:
    """Turn and mirror an image by the nearest of the eight orientations of a display matrix (ISO 14496-12, 8.5.2).

    display_matrix: rows a b u, c d v, x y w; x' = a x + c y, y' = b x + d y, y down.
    """
    a, b, _, c, d = display_matrix[:5].tolist()
    if abs(b) > abs(a):
        pixels, a, d = pixels.swapaxes(0, 1), c, b
    return pixels[:: -1 if d < 0 else 1, :: -1 if a < 0 else 1]


def replace_second_field(rows: Shaped[np.ndarray, "h w"]) -> None:
    """Replace the odd rows in place by the mean of their neighbours; a last row without a lower one becomes a copy."""
    above = rows[: len(rows) - 1 : 2]
    below = np.concatenate([rows[2::2], above[-1:]])[: len(above)]
    rows[1::2] = ((above.astype(np.uint32) + below + 1) // 2).astype(rows.dtype)


def _deinterlace(picture: av.VideoFrame) -> None:
    """Keep one field of each plane: the fields were exposed at two times, and chroma rows belong to fields as well."""
    picture.make_writable()
    is_deep = any(component.bits > 8 for component in picture.format.components)
    for plane in picture.planes:
        samples = cast(memoryview, plane)  # a buffer, which type checkers learn from Python 3.12 on
        rows = np.frombuffer(samples, np.uint16 if is_deep else np.uint8)
        if plane.height >= 2:
            replace_second_field(rows.reshape(plane.height, -1))


def _missing_matrix(picture: av.VideoFrame) -> int | None:
    """Return libswscale's code of the likely matrix of a file that names none, by mpv's rule; None: as the file says.

    Without it all would be BT.601, whose reds and greens are off by up to 20 levels in HD video.
    """
    name = picture.format.name
    if int(picture.colorspace) != _UNSPECIFIED_MATRIX or not name.startswith(_YUV_FORMATS) or name.startswith("yuvj"):
        return None
    if int(picture.color_trc) in hdr.HDR_TRANSFERS:
        return _SWS_BT_2020
    is_hd = picture.width >= _HD_MIN_WIDTH_PX or picture.height > _SD_MAX_HEIGHT_PX
    return _SWS_BT_709 if is_hd else None
