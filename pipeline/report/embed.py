"""Data for embedding in an HTML file: WebP data URIs, and a GLB with smaller textures."""

import base64
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from pipeline.io.glb import GlbFile
from pipeline.io.glb_writer import GlbWriter

MAX_COVERAGE_PX = 1024
"""Side of the coverage map in the 3D view; finer texels are not told apart there."""

COVERAGE_MARGIN_PX = 3
"""Texels by which the coverage of a chart grows into its gutter; viewers blend texels across the edge of a chart."""

WEBP_QUALITY = 84
JPEG_QUALITY = 88


def webp_data_uri(pixels: UInt8[np.ndarray, "h w c"]) -> str:
    """Return a `data:` URI of an RGB image, or of an RGBA image with straight alpha, as WebP.

    Raises:
        ValueError: the image cannot be encoded.
    """
    order = cv2.COLOR_RGBA2BGRA if pixels.shape[2] == 4 else cv2.COLOR_RGB2BGR
    encoded, data = cv2.imencode(".webp", cv2.cvtColor(pixels, order), (cv2.IMWRITE_WEBP_QUALITY, WEBP_QUALITY))
    if not encoded:
        raise ValueError(f"an image of shape {pixels.shape} cannot be encoded as WebP")
    return f"data:image/webp;base64,{base64.b64encode(data.tobytes()).decode()}"


def coverage_data_uri(coverage: UInt8[np.ndarray, "h w"]) -> str:
    """Return a `data:` URI of the coverage map in colours: viridis, from texels that were filled in to well seen ones.

    coverage: confidence that the video shows a texel, 0 to 255.
    """
    margin = cv2.dilate(coverage, np.ones((3, 3), np.uint8), iterations=COVERAGE_MARGIN_PX)
    coverage = np.where(coverage == 0, margin, coverage)
    scale = MAX_COVERAGE_PX / max(coverage.shape)
    if scale < 1.0:
        coverage = cv2.resize(coverage, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return webp_data_uri(cv2.cvtColor(cv2.applyColorMap(coverage, cv2.COLORMAP_VIRIDIS), cv2.COLOR_BGR2RGB))


def read_level(path: Path) -> bytes:
    """Return a level of detail without its clips: the 3D view plays those of the finest level on all of them.

    Raises:
        UserError: the file is not a .glb.
    """
    document = GlbWriter.from_file(GlbFile(path))
    document.json.pop("animations", None)
    document.remove_unused()
    return document.to_bytes()


def compress_glb_textures(glb: bytes, max_texture_px: int = 2048) -> bytes:
    """Return the model with its opaque textures as JPEG of at most `max_texture_px` a side.

    For display only: geometry, skin and animation keep their bytes; textures with alpha stay PNG. A texture is
    unchanged if its JPEG is not smaller.

    Raises:
        UserError: the file is no .glb, or a texture is in another file.
    """
    file = GlbFile(Path("avatar.glb"), glb)
    document = GlbWriter.from_file(file)
    for index in range(len(file.gltf.get("images", ()))):
        original = file.image_bytes(index)
        smaller = _encode_jpeg(original, max_texture_px)
        if smaller is not None and len(smaller) < len(original):
            document.replace_image(index, smaller, "image/jpeg")
    document.remove_unused()
    return document.to_bytes()


def _encode_jpeg(encoded: bytes, max_texture_px: int) -> bytes | None:
    """Return the image as JPEG; None if it has an alpha channel, which JPEG cannot store."""
    pixels = cv2.imdecode(np.frombuffer(encoded, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None or (pixels.ndim == 3 and pixels.shape[2] == 4):
        return None
    scale = max_texture_px / max(pixels.shape[:2])
    if scale < 1.0:
        pixels = cv2.resize(pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", pixels, (cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY))[1].tobytes()
