"""Round trips through files, EXIF orientation against hand-rotated pixels, and files that cannot be read."""

import cv2
import numpy as np
import pytest

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
