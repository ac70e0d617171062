"""Alpha of image files: colours come without premultiplication, whatever the file holds."""

from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from PIL import Image

from pipeline.io import image


@pytest.mark.parametrize("suffix", [".png", ".tif", ".webp"])
def test_colours_below_transparent_pixels_are_kept(tmp_path, suffix):
    rgba = np.full((4, 4, 4), (200, 100, 50, 0), np.uint8)
    rgba[0] = (10, 20, 30, 128)
    Image.fromarray(rgba).save(tmp_path / f"a{suffix}", lossless=True, exact=True)
    np.testing.assert_array_equal(image.read_rgba(tmp_path / f"a{suffix}"), rgba)
    np.testing.assert_array_equal(image.read_rgb(tmp_path / f"a{suffix}"), rgba[..., :3])
    np.testing.assert_array_equal(image.read_alpha(tmp_path / f"a{suffix}"), rgba[..., 3])


def write_tiff(path: Path, pixels: np.ndarray, extra_samples: int) -> None:
    """A TIFF with the values as they are and this tag: 0 says nothing, 1 premultiplied alpha, 2 straight alpha."""
    spec = oiio.ImageSpec(*pixels.shape[1::-1], pixels.shape[2], pixels.dtype.name)
    spec.alpha_channel = pixels.shape[2] - 1
    spec.attribute("oiio:UnassociatedAlpha", int(extra_samples == 2))
    spec.attribute("tiff:write_exif", 0)
    file = oiio.ImageOutput.create(str(path))
    assert file.open(str(path), spec)
    assert file.write_image(np.ascontiguousarray(pixels))
    file.close()
    if extra_samples == 0:
        premultiplied, unspecified = (b"\x52\x01\x03\0\x01\0\0\0" + bytes([value, 0]) for value in (1, 0))
        path.write_bytes(path.read_bytes().replace(premultiplied, unspecified))
    if pixels.shape[2] == 4:  # Pillow reads no such file of two channels
        assert Image.open(path).tag_v2[338] == (extra_samples,)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_premultiplied_tiff_is_read_straight(tmp_path: Path, dtype: type) -> None:
    """Compositors write such files."""
    white = np.iinfo(dtype).max
    straight = np.array([[[1.0, 0.5, 0.2, 1.0], [1.0, 0.5, 0.2, 0.4], [0.0, 0.0, 0.0, 0.0]]])
    premultiplied = straight * np.concatenate([straight[..., 3:].repeat(3, axis=2), np.ones_like(straight[..., :1])], 2)
    write_tiff(tmp_path / "a.tif", np.rint(premultiplied * white).astype(dtype), extra_samples=1)
    np.testing.assert_allclose(image.read_rgb_float(tmp_path / "a.tif"), straight[..., :3], atol=0.006)
    np.testing.assert_allclose(image.read_rgba(tmp_path / "a.tif") / 255.0, straight, atol=0.006)
    gray = np.rint(premultiplied[..., [1, 3]] * white).astype(dtype)
    write_tiff(tmp_path / "g.tif", gray, extra_samples=1)
    np.testing.assert_allclose(image.read_gray(tmp_path / "g.tif") / 255.0, straight[..., 1], atol=0.006)


@pytest.mark.parametrize("extra_samples", [0, 2])
def test_other_tiff_is_read_as_it_is(tmp_path: Path, extra_samples: int) -> None:
    pixels = np.array([[[200, 100, 50, 128], [200, 100, 50, 0]]], np.uint8)
    write_tiff(tmp_path / "a.tif", pixels, extra_samples)
    np.testing.assert_array_equal(image.read_rgba(tmp_path / "a.tif"), pixels)
