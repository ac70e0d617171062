"""Round trips through files, EXIF orientation against hand-rotated pixels, colour profiles against the equations of
their spaces, and files that cannot be read."""

import struct

import cv2
import numpy as np
import pytest
from PIL import Image

from pipeline.core.errors import UserError
from pipeline.io import image


@pytest.fixture
def pixels() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (7, 11, 3), dtype=np.uint8)


def test_rgb_round_trip_keeps_channel_order(tmp_path, pixels):
    pixels[..., 0] = 255
    image.write_rgb(tmp_path / "a.png", pixels)
    np.testing.assert_array_equal(image.read_rgb(tmp_path / "a.png"), pixels)
    assert cv2.imread(str(tmp_path / "a.png"))[0, 0, 2] == 255


def test_gray_and_rgba_round_trip(tmp_path, pixels):
    image.write_gray(tmp_path / "g.png", pixels[..., 0])
    np.testing.assert_array_equal(image.read_gray(tmp_path / "g.png"), pixels[..., 0])
    rgba = np.concatenate([pixels, pixels[..., :1]], axis=2)
    image.write_rgba(tmp_path / "a.png", rgba)
    np.testing.assert_array_equal(image.read_rgba(tmp_path / "a.png"), rgba)


def test_rgba_of_an_opaque_image_is_255(tmp_path, pixels):
    image.write_rgb(tmp_path / "a.png", pixels)
    rgba = image.read_rgba(tmp_path / "a.png")
    np.testing.assert_array_equal(rgba[..., :3], pixels)
    assert (rgba[..., 3] == 255).all()


def test_sixteen_bit_gray_becomes_eight_bit_rgba(tmp_path):
    cv2.imwrite(str(tmp_path / "d.png"), np.full((2, 3), 65535, np.uint16))
    assert (image.read_rgba(tmp_path / "d.png") == 255).all()


def test_same_pixels_same_bytes(tmp_path, pixels):
    for name in ("a.png", "b.png"):
        image.write_rgb(tmp_path / name, pixels)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_exif_orientation_is_honoured(tmp_path):
    upright = np.zeros((16, 32, 3), np.uint8)
    upright[:, 16:] = 255
    jpeg = cv2.imencode(".jpg", upright)[1].tobytes()
    # APP1 segment with one little-endian TIFF entry: tag 0x0112 (orientation), SHORT, 6 = rotate 90 degrees clockwise.
    tiff = b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0"
    segment = b"Exif\0\0" + tiff
    exif = b"\xff\xe1" + (len(segment) + 2).to_bytes(2, "big") + segment
    (tmp_path / "a.jpg").write_bytes(jpeg[:2] + exif + jpeg[2:])
    shown = image.read_rgb(tmp_path / "a.jpg")
    assert shown.shape == (32, 16, 3)
    assert shown[:12].mean() < 5
    assert shown[20:].mean() > 250


# Primaries in XYZ beside D50, as the profiles of Apple and Adobe have them.
DISPLAY_P3 = ((0.51512, 0.2412, -0.00105), (0.29198, 0.69225, 0.04189), (0.1571, 0.06657, 0.78407))
ADOBE_RGB = ((0.60974, 0.31111, 0.01947), (0.20528, 0.62567, 0.06087), (0.14919, 0.06322, 0.74457))
# Their linear light to sRGB's, from the primaries' chromaticities beside D65.
P3_TO_SRGB = np.array([[1.2249, -0.2247, 0.0], [-0.0420, 1.0419, 0.0], [-0.0197, -0.0786, 1.0979]])
ADOBE_TO_SRGB = np.array([[1.3984, -0.3984, 0.0], [0.0, 1.0, 0.0], [0.0, -0.0429, 1.0429]])


COLORANTS = (b"rXYZ", b"gXYZ", b"bXYZ")


def fixed(*values: float) -> bytes:
    return struct.pack(f">{len(values)}i", *(round(65536 * value) for value in values))


def icc_profile(primaries, curve: int, *parameters: float, space: bytes = b"RGB ") -> bytes:
    """ICC.1 version 4: primaries, and a parametric curve that makes signals linear light."""
    shape = b"para" + bytes(4) + struct.pack(">HH", curve, 0) + fixed(*parameters)
    tags = {name: b"XYZ " + bytes(4) + fixed(*xyz) for name, xyz in zip(COLORANTS, primaries, strict=True)}
    tags |= {b"wtpt": b"XYZ " + bytes(4) + fixed(0.9642, 1.0, 0.8249)}
    tags |= dict.fromkeys((b"rTRC", b"gTRC", b"bTRC", b"kTRC"), shape)
    table, data, start = struct.pack(">I", len(tags)), b"", 132 + 12 * len(tags)
    for name, value in tags.items():
        table += name + struct.pack(">II", start + len(data), len(value))
        data += value
    head = struct.pack(">I", start + len(data)) + bytes(4) + b"\4\x30\0\0mntr" + space + b"XYZ " + bytes(12) + b"acsp"
    return head + bytes(28) + fixed(0.9642, 1.0, 0.8249) + bytes(48) + table + data


def linear(coded: np.ndarray) -> np.ndarray:
    return np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)


def srgb_levels(light: np.ndarray) -> np.ndarray:
    light = np.clip(light, 0.0, 1.0)
    return 255.0 * np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


P3_PROFILE = icc_profile(DISPLAY_P3, 3, 2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)


@pytest.mark.parametrize("suffix", [".png", ".tif", ".webp"])
def test_display_p3_becomes_srgb(tmp_path, pixels, suffix):
    Image.fromarray(pixels).save(tmp_path / f"a{suffix}", icc_profile=P3_PROFILE, lossless=True)
    expected = srgb_levels(linear(pixels / 255.0) @ P3_TO_SRGB.T)
    assert np.abs(expected - pixels).max() > 20
    np.testing.assert_allclose(image.read_rgb(tmp_path / f"a{suffix}"), expected, atol=1.0)


def test_adobe_rgb_of_a_jpeg_becomes_srgb(tmp_path):
    skin = np.full((16, 16, 3), (190, 150, 130), np.uint8)
    profile = icc_profile(ADOBE_RGB, 0, 2.19921875)
    Image.fromarray(skin).save(tmp_path / "a.jpg", icc_profile=profile, quality=100)
    expected = srgb_levels((skin / 255.0) ** 2.19921875 @ ADOBE_TO_SRGB.T)
    assert expected[0, 0, 0] > 200
    np.testing.assert_allclose(image.read_rgb(tmp_path / "a.jpg"), expected, atol=2.0)


def test_a_gray_profile_makes_gray_and_levels_of_masks_stay(tmp_path):
    levels = np.arange(256, dtype=np.uint8).reshape(16, 16)
    Image.fromarray(levels).save(tmp_path / "a.png", icc_profile=icc_profile(DISPLAY_P3, 0, 1.8, space=b"GRAY"))
    expected = np.repeat(srgb_levels((levels / 255.0) ** 1.8)[..., None], 3, axis=2)
    assert np.abs(expected - levels[..., None]).max() > 15
    np.testing.assert_allclose(image.read_rgb(tmp_path / "a.png"), expected, atol=2.0)
    np.testing.assert_array_equal(image.read_gray(tmp_path / "a.png"), levels)


@pytest.mark.parametrize("profile", [b"junk", icc_profile(DISPLAY_P3, 0, 1.0, space=b"CMYK")])
def test_unusable_profile_is_reported(tmp_path, pixels, profile):
    Image.fromarray(pixels).save(tmp_path / "a.png", icc_profile=profile)
    with pytest.raises(UserError, match="colour profile of image .*a.png"):
        image.read_rgb(tmp_path / "a.png")


@pytest.mark.parametrize("suffix", [".png", ".tif"])
@pytest.mark.parametrize("shape", [(16, 16), (16, 16, 3)])
def test_sixteen_bits_become_eight(tmp_path, suffix, shape):
    deep = np.linspace(0, 65535, int(np.prod(shape))).reshape(shape).astype(np.uint16)
    cv2.imwrite(str(tmp_path / f"a{suffix}"), deep)
    rgb = image.read_rgb(tmp_path / f"a{suffix}")
    expected = np.repeat(deep[..., None], 3, axis=2) if deep.ndim == 2 else deep[..., ::-1]
    np.testing.assert_allclose(rgb, expected / 257.0, atol=1.0)


def test_floating_point_pictures_are_refused(tmp_path):
    cv2.imwrite(str(tmp_path / "a.tif"), np.zeros((4, 4, 3), np.float32))
    with pytest.raises(UserError, match="a.tif is of a kind"):
        image.read_rgb(tmp_path / "a.tif")


@pytest.mark.parametrize("mode", ["1", "L", "LA", "P", "RGBA"])
def test_every_kind_of_png_becomes_colours(tmp_path, mode):
    """A chequered picture, left half opaque where there is alpha; the colours below it come as they are stored."""
    chequered = Image.fromarray(np.kron([[0, 255], [255, 0]], np.ones((4, 4))).astype(np.uint8)).convert(mode)
    if "A" in mode:
        chequered.putalpha(Image.fromarray(np.repeat([[255, 0]], 4, axis=1).repeat(8, axis=0).astype(np.uint8)))
    chequered.save(tmp_path / "a.png")
    expected = np.kron([[0, 255], [255, 0]], np.ones((4, 4)))
    np.testing.assert_array_equal(image.read_rgb(tmp_path / "a.png"), np.repeat(expected[..., None], 3, axis=2))


def test_float_and_back_is_exact():
    every_level = np.arange(256, dtype=np.uint8)
    np.testing.assert_array_equal(image.to_uint8(image.to_float(every_level)), every_level)
    np.testing.assert_array_equal(image.to_uint8(np.array([-0.2, 1.7])), [0, 255])


@pytest.mark.parametrize("content", [b"", b"not an image"])
def test_damaged_file_is_named(tmp_path, content):
    (tmp_path / "broken.png").write_bytes(content)
    with pytest.raises(UserError, match="broken.png"):
        image.read_rgb(tmp_path / "broken.png")


def test_missing_file_is_named(tmp_path):
    with pytest.raises(UserError, match="nowhere.png"):
        image.read_gray(tmp_path / "nowhere.png")
