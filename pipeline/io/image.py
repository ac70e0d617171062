"""Image files: decoding, encoding, filtered resizing and hole filling. The only module that uses OpenImageIO.

Arrays have RGB order and row 0 at the top; alpha is not premultiplied. Integer and float pixels are sRGB; white is the
largest integer or 1.0. OpenEXR files hold linear light of the sRGB primaries and are converted on reading and writing.
The encoded bytes depend only on the pixels, so equal pixels give equal file digests.

OpenImageIO keeps the ICC profile of a file but cannot apply it: Pillow does (LittleCMS). It does not read EXIF of WebP
files either: Pillow does.
"""

import os
import struct
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
from jaxtyping import Bool, Float, Float32, Shaped, UInt8
from PIL import ExifTags, Image, ImageCms

from pipeline.core.errors import UserError
from pipeline.geometry.colour import linear_to_srgb, srgb_to_linear

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff", ".ppm", ".exr")

_LUMA = np.array([0.299, 0.587, 0.114], dtype=np.float32)
"""Weights of sRGB in luma (ITU-R BT.601), as in JPEG."""
_SRGB = ImageCms.createProfile("sRGB")
_PILLOW_MODE = {"RGB": "RGB", "GRAY": "L"}
"""Pillow's image mode for the colour space of an ICC profile."""

_BT_709_PRIMARIES = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06)
"""Chromaticities x, y of red, green and blue in sRGB, which are OpenEXR's default."""
_HARMLESS_WARNING = "extraneous bytes before marker"
"""libjpeg's warning about padding that some cameras write; the pixels are complete."""

# A damaged or malicious header may claim any size: refuse to allocate more than this.
oiio.attribute("limits:imagesize_MB", 1024)


@dataclass(frozen=True)
class _Encoding:
    """How a format is written. dtypes: what the pixels may be. stored: the type in the file, if it is another one."""

    format_name: str
    dtypes: tuple[str, ...]
    attributes: Mapping[str, str | int]
    stored: str | None = None


# PNG's filter "up" for all rows takes half of the time of the best filter for each row, at equal size (630 x 630 px
# frame: 9 and 21 ms, 208 and 211 kB). Level 6 takes 34 ms for 166 kB.
_PNG_FILTER_UP = 32
_PNG = _Encoding("png", ("uint8", "uint16"), {"png:compressionLevel": 1, "png:filter": _PNG_FILTER_UP})
_JPEG = _Encoding("jpeg", ("uint8",), {"compression": "jpeg:92"})
# Without an empty DateTime the time of writing would be stored.
_TIFF = _Encoding("tiff", ("uint8", "uint16"), {"compression": "zip", "tiff:write_exif": 0, "DateTime": ""})
_EXR = _Encoding("openexr", ("float32",), {"compression": "zip", "DateTime": ""}, stored="half")
_ENCODINGS = {".png": _PNG, ".jpg": _JPEG, ".jpeg": _JPEG, ".tif": _TIFF, ".tiff": _TIFF, ".exr": _EXR}


@dataclass(frozen=True)
class _Decoded:
    """A file's first image as it is stored: uint8, uint16 or, from OpenEXR, float32 sRGB. colour: 1 or 3 channels."""

    colour: Shaped[np.ndarray, "h w c"]
    alpha: Shaped[np.ndarray, "h w"] | None
    orientation: int
    icc_profile: bytes


def read_rgb(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    """Read a colour image as 8-bit sRGB with the EXIF orientation applied; an alpha channel is dropped.

    Colours of another space (phones write Display P3, cameras Adobe RGB) are converted if the file has an ICC profile.
    16-bit values are rounded to 8 bits, OpenEXR's are clipped at white.
    Raises UserError when the file is missing, damaged or no image, or when its profile cannot be used.
    """
    decoded = _decode(path)
    return _apply_profile(_upright(_three_channels(to_uint8(decoded.colour)), decoded.orientation), decoded, path)


def read_rgb_float(path: Path) -> Float32[np.ndarray, "h w 3"]:
    """Read a colour image as `read_rgb` does, in the file's full depth: float32 sRGB, above 1 only from OpenEXR.

    An image with an ICC profile is limited to the 8 bits that the conversion works in. Raises UserError as `read_rgb`.
    """
    decoded = _decode(path)
    if decoded.icc_profile:
        return to_float(read_rgb(path))
    return _upright(_three_channels(to_float(decoded.colour)), decoded.orientation)


def read_gray(path: Path) -> UInt8[np.ndarray, "h w"]:
    """Read an 8-bit image of one channel, for example a mask, with the EXIF orientation applied.

    Colours become luma, an ICC profile is ignored, an alpha channel is dropped. Raises UserError as `read_rgb`.
    """
    decoded = _decode(path)
    return _upright(_luma(to_uint8(decoded.colour)), decoded.orientation)


def read_gray_uint16(path: Path) -> Shaped[np.ndarray, "h w"]:
    """Read an image of one channel as `read_gray` does, in 16 bits: those of the file, or 257 times its 8-bit levels.

    Raises UserError as `read_rgb`.
    """
    decoded = _decode(path)
    colour = decoded.colour if decoded.colour.dtype == np.uint16 else to_uint8(decoded.colour)
    gray = _luma(colour).astype(np.uint16)
    return _upright(gray if colour.dtype == np.uint16 else 257 * gray, decoded.orientation)


def read_rgba(path: Path) -> UInt8[np.ndarray, "h w 4"]:
    """Read an 8-bit image as it is stored (no EXIF, no profile), with alpha, which is 255 where the file has none.

    Raises UserError as `read_rgb`.
    """
    decoded = _decode(path)
    colour = _three_channels(to_uint8(decoded.colour))
    opaque = np.full(colour.shape[:2], 255, dtype=np.uint8)
    return np.dstack([colour, opaque if decoded.alpha is None else to_uint8(decoded.alpha)])


def read_alpha(path: Path) -> UInt8[np.ndarray, "h w"]:
    """Read the alpha channel with the EXIF orientation applied, 255 where the file has none.

    Raises UserError as `read_rgb`.
    """
    decoded = _decode(path)
    if decoded.alpha is None:
        return _upright(np.full(decoded.colour.shape[:2], 255, dtype=np.uint8), decoded.orientation)
    return _upright(to_uint8(decoded.alpha), decoded.orientation)


def read_exif_tag(path: Path, tag: int, directory: int | None = None) -> object:
    """Read an EXIF tag of a file, or of one of its sub-directories (`PIL.ExifTags.IFD`).

    Returns None when there is no such tag, when the metadata is damaged or when the file is no image.
    """
    try:
        with Image.open(path) as header:
            exif = header.getexif()
            return (exif if directory is None else exif.get_ifd(directory)).get(tag)
    except (OSError, SyntaxError, ValueError, struct.error, Image.DecompressionBombError):
        return None


def write_rgb(path: Path, pixels: Shaped[np.ndarray, "h w 3"]) -> None:
    """Write a colour image in the format of the suffix.

    PNG and TIFF hold uint8 or uint16, JPEG uint8, OpenEXR float32 (sRGB, stored as linear half floats).
    Raises UserError when the suffix is none of these or the format cannot hold the dtype, OSError when the file cannot
    be written.
    """
    _write(path, pixels)


def write_gray(path: Path, pixels: Shaped[np.ndarray, "h w"]) -> None:
    """Write an image of one channel. Formats and errors as of `write_rgb`."""
    _write(path, pixels[..., None])


def write_rgba(path: Path, pixels: Shaped[np.ndarray, "h w 4"]) -> None:
    """Write a PNG or TIFF image with alpha. Errors as of `write_rgb`."""
    if path.suffix.lower() not in (".png", ".tif", ".tiff"):
        raise UserError(f"image {path} cannot hold alpha; choose .png or .tif")
    _write(path, pixels)


def png_bytes(pixels: UInt8[np.ndarray, "h w c"], compression: int = 6) -> bytes:
    """Encode an RGB or RGBA image as PNG in memory, for files that contain images. compression: 0 to 9."""
    attributes = {"png:compressionLevel": compression, "png:filter": _PNG_FILTER_UP}
    return _encode(pixels, _Encoding("png", ("uint8",), attributes))


def to_float(pixels: Shaped[np.ndarray, "*shape"]) -> Float32[np.ndarray, "*shape"]:
    """Convert uint8 or uint16 to float32 in [0, 1]; float32 stays."""
    if pixels.dtype == np.float32:
        return pixels
    return pixels.astype(np.float32) / np.float32(np.iinfo(pixels.dtype).max)


def to_uint8(values: Shaped[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape"]:
    """Convert floats in [0, 1] or uint16 to uint8, rounded to nearest and clipped; `to_uint8(to_float(x)) == x`."""
    if values.dtype == np.uint8:
        return values
    if values.dtype == np.uint16:
        return ((values.astype(np.uint32) + 128) // 257).astype(np.uint8)
    return np.clip(np.rint(values * 255.0), 0, 255).astype(np.uint8)


def to_uint16(values: Float[np.ndarray, "*shape"]) -> Shaped[np.ndarray, "*shape"]:
    """Convert floats in [0, 1] to uint16, rounded to nearest and clipped."""
    return np.clip(np.rint(values * 65535.0), 0, 65535).astype(np.uint16)


def resize(
    pixels: Shaped[np.ndarray, "h w c"], width_px: int, height_px: int, filter_name: str = "catmull-rom"
) -> Shaped[np.ndarray, "h2 w2 c"]:
    """Resample a uint8 or float32 image with one of OpenImageIO's filters, scaled to the larger of the two grids.

    Slow, for images that are shown: shrinking a pattern finer than the new pixels leaves 7 % of its amplitude at 3/4 of
    the old frequency limit, area averaging 38 %. For loops and masks use OpenCV's INTER_AREA, which is 100 times faster
    and averages areas exactly at every ratio; OpenImageIO's "box" does so at whole ratios only.
    Raises ValueError for an unknown filter.
    """
    region = oiio.ROI(0, width_px, 0, height_px, 0, 1, 0, pixels.shape[2])
    return _pixels_of(oiio.ImageBufAlgo.resize(oiio.ImageBuf(pixels), filter_name, 0.0, region))


def push_pull(image: Float32[np.ndarray, "h w c"], known: Bool[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w c"]:
    """Fill unknown pixels from ever coarser means of the known ones (Gortler et al., "The Lumigraph", 1996).

    Known pixels stay; all pixels are 0 when none is known.
    """
    height, width, channels = image.shape
    spec = oiio.ImageSpec(width, height, channels + 1, "float")
    spec.alpha_channel = channels
    source, pixels = oiio.ImageBuf(spec), np.zeros((height, width, channels + 1), np.float32)
    np.copyto(pixels[..., :channels], image, where=known[..., None])
    pixels[..., channels] = known
    source.set_pixels(spec.roi, pixels)
    del pixels  # as large as the picture, like each of the next
    filled = _pixels_of(oiio.ImageBufAlgo.fillholes_pushpull(source))
    return np.ascontiguousarray(filled[..., :channels])


def _pixels_of(buffer: oiio.ImageBuf) -> np.ndarray:
    pixels = None if buffer.has_error else buffer.get_pixels(buffer.spec().format)
    if pixels is None:
        raise ValueError(buffer.geterror())
    return pixels


def _decode(path: Path) -> _Decoded:
    if path.is_dir():
        raise UserError(f"image {path} is a folder; name an image file")
    if not path.is_file():
        raise UserError(f"image {path} does not exist; check the contents of the folder")
    try:
        pixels, orientation, profile, format_name, is_premultiplied = _read_file(path)
    except (ValueError, RuntimeError) as error:  # C++ exceptions, for damaged headers
        raise _unreadable(path, str(error)) from None
    is_exr = format_name == "openexr"
    if pixels.dtype not in (np.uint8, np.uint16) and not is_exr:
        raise UserError(f"image {path} holds {pixels.dtype.name} values, which are not read; save it as a PNG or JPEG")
    if pixels.shape[2] > 4:
        raise UserError(f"image {path} has {pixels.shape[2]} channels; save it with the channels R, G, B only")
    has_alpha = pixels.shape[2] in (2, 4)
    colour, alpha = (pixels[..., :-1], pixels[..., -1]) if has_alpha else (pixels, None)
    if is_exr:
        colour, alpha = _srgb_of_exr(colour, alpha, path)
    elif is_premultiplied and alpha is not None:
        colour = _divide_by_alpha(colour, alpha)
    return _Decoded(colour, alpha, orientation, profile)


def _read_file(path: Path) -> tuple[Shaped[np.ndarray, "h w c"], int, bytes, str, bool]:
    """Return pixels, EXIF orientation, ICC profile (empty if there is none) and OpenImageIO's name of the format.

    The last value is whether it is a TIFF whose integer colours are premultiplied by its alpha, as the file says.
    """
    keep_alpha_straight = oiio.ImageSpec()
    keep_alpha_straight.attribute("oiio:UnassociatedAlpha", 1)
    file = oiio.ImageInput.open(str(path), keep_alpha_straight)
    if file is None:
        raise _unreadable(path, oiio.geterror())
    # The spec becomes invalid when the file is closed, so its attributes are read before.
    spec, format_name = file.spec(), file.format_name()
    profile = spec.getattribute("ICCProfile")
    orientation = spec.get_int_attribute("Orientation", 1)
    if format_name == "webp":
        tag = read_exif_tag(path, ExifTags.Base.Orientation)
        orientation = tag if isinstance(tag, int) else 1
    is_straight = spec.get_int_attribute("oiio:UnassociatedAlpha") or spec.alpha_channel < 0
    is_premultiplied = format_name == "tiff" and not is_straight
    primaries = spec.getattribute("chromaticities")
    if primaries is not None and not np.allclose(primaries[:6], _BT_709_PRIMARIES, atol=1e-3):
        raise UserError(f"image {path} has other primaries than sRGB; convert it to linear sRGB")
    pixels = file.read_image(oiio.UNKNOWN)
    message = file.geterror()
    file.close()
    if pixels is None or (message and _HARMLESS_WARNING not in message):
        raise _unreadable(path, message)
    return pixels, orientation, b"" if profile is None else bytes(profile), format_name, is_premultiplied


def _unreadable(path: Path, message: str) -> UserError:
    reason = message.partition("\n")[0] or "no image"
    return UserError(f"image {path} cannot be read ({reason}); replace or remove it")


def _srgb_of_exr(
    light: Shaped[np.ndarray, "h w c"], alpha: Shaped[np.ndarray, "h w"] | None, path: Path
) -> tuple[Float32[np.ndarray, "h w c"], Float32[np.ndarray, "h w"] | None]:
    """Convert linear light, premultiplied if there is alpha, to sRGB. Raises UserError for infinite values or NaN."""
    light = light.astype(np.float32)
    if not np.isfinite(light).all():
        raise UserError(f"image {path} holds values that are not finite; save it again without them")
    if alpha is not None:
        alpha = alpha.astype(np.float32)
        light = light / np.where(alpha > 0, alpha, 1.0)[..., None]
    return linear_to_srgb(np.maximum(light, 0.0)).astype(np.float32), alpha


def _divide_by_alpha(
    colour: Shaped[np.ndarray, "h w c"], alpha: Shaped[np.ndarray, "h w"]
) -> Shaped[np.ndarray, "h w c"]:
    """Return the straight colours of premultiplied integer ones; they stay where alpha is 0."""
    white = np.iinfo(colour.dtype).max
    share = np.where(alpha > 0, alpha, white).astype(np.float32) / np.float32(white)
    return np.minimum(np.rint(colour / share[..., None]), white).astype(colour.dtype)


def _upright(pixels: Shaped[np.ndarray, "..."], orientation: int) -> Shaped[np.ndarray, "..."]:
    """Apply an EXIF orientation, 1 to 8 (TIFF 6.0, tag 274); other values change nothing.

    OpenImageIO 3.0's own `reorient` exchanges 5 and 7.
    """
    if orientation in (5, 6, 7, 8):
        pixels = pixels.swapaxes(0, 1)
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    return np.ascontiguousarray(pixels)


def _luma(colour: Shaped[np.ndarray, "h w c"]) -> Shaped[np.ndarray, "h w"]:
    return np.rint(colour @ _LUMA).astype(colour.dtype) if colour.shape[2] == 3 else colour[..., 0]


def _three_channels(colour: Shaped[np.ndarray, "h w c"]) -> Shaped[np.ndarray, "h w 3"]:
    return np.repeat(colour, 3, axis=2) if colour.shape[2] == 1 else colour


def _apply_profile(rgb: UInt8[np.ndarray, "h w 3"], decoded: _Decoded, path: Path) -> UInt8[np.ndarray, "h w 3"]:
    if not decoded.icc_profile:
        return rgb
    try:
        profile = ImageCms.getOpenProfile(BytesIO(decoded.icc_profile))
        space = profile.profile.xcolor_space.strip()
        pixels = Image.fromarray(rgb).convert(_PILLOW_MODE.get(space, "RGB"))
        return np.array(ImageCms.profileToProfile(pixels, profile, _SRGB, outputMode="RGB"))
    except ImageCms.PyCMSError as error:
        raise UserError(f"the colour profile of image {path} cannot be used ({error}); save it again as sRGB") from None


def _write(path: Path, pixels: Shaped[np.ndarray, "h w c"]) -> None:
    encoding = _ENCODINGS.get(path.suffix.lower())
    if encoding is None:
        raise UserError(f"image {path} cannot be written as {path.suffix}; choose one of {', '.join(_ENCODINGS)}")
    if pixels.dtype.name not in encoding.dtypes:
        raise UserError(f"image {path} cannot hold {pixels.dtype.name} values; choose another format")
    path.write_bytes(_encode(pixels, encoding))


def _encode(pixels: Shaped[np.ndarray, "h w c"], encoding: _Encoding) -> bytes:
    """Return the bytes of an image file.

    OpenImageIO's Python binding writes to paths only. The path is not the final one, because a full disk would end the
    process in the JPEG encoder: memory on Linux, a temporary folder elsewhere.
    """
    height, width, channels = pixels.shape
    spec = oiio.ImageSpec(width, height, channels, encoding.stored or pixels.dtype.name)
    spec.attribute("oiio:UnassociatedAlpha", 1)
    for name, value in encoding.attributes.items():
        spec.attribute(name, value)
    values = srgb_to_linear(pixels) if encoding is _EXR else pixels
    with _scratch_file(encoding.format_name) as path:
        file = oiio.ImageOutput.create(encoding.format_name)
        written = file.open(str(path), spec) and file.write_image(values) and file.close()
        message = file.geterror()
        if not written or message:
            raise ValueError(f"an image of shape {pixels.shape} cannot be encoded as {encoding.format_name}: {message}")
        return path.read_bytes()


@contextmanager
def _scratch_file(name: str) -> Iterator[Path]:
    """Yield a path for a file that disappears: in memory where the system has memfd, else in a temporary folder."""
    if hasattr(os, "memfd_create"):
        descriptor = os.memfd_create(name)
        try:
            yield Path(f"/proc/self/fd/{descriptor}")
        finally:
            os.close(descriptor)
    else:
        with tempfile.TemporaryDirectory() as folder:
            yield Path(folder) / name
