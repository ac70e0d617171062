"""Round trips through files, EXIF orientation against Pillow, colour profiles against the equations of their spaces,
files that cannot be read."""

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import OpenImageIO as oiio
import pytest
from PIL import Image, ImageOps

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


def read_by_others(path: Path) -> np.ndarray:
    """Pillow reads no 16-bit colours, OpenCV multiplies the colours of 8-bit TIFF by alpha: each reads the rest."""
    stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if stored.dtype == np.uint8:
        return np.asarray(Image.open(path))
    return stored[..., [2, 1, 0, 3][: stored.shape[2]]] if stored.ndim == 3 else stored


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_all_depths_and_channels_are_lossless(tmp_path, suffix, dtype):
    rgba = np.random.default_rng(1).integers(0, np.iinfo(dtype).max, (6, 5, 4), dtype=dtype, endpoint=True)
    for write, pixels in ((image.write_gray, rgba[..., 0]), (image.write_rgb, rgba[..., :3]), (image.write_rgba, rgba)):
        write(tmp_path / f"a{suffix}", pixels)
        np.testing.assert_array_equal(read_by_others(tmp_path / f"a{suffix}"), pixels)
    np.testing.assert_array_equal(image.read_rgba(tmp_path / f"a{suffix}"), image.to_uint8(rgba))
    np.testing.assert_array_equal(image.read_rgb(tmp_path / f"a{suffix}"), image.to_uint8(rgba)[..., :3])
    expected = rgba[..., :3].astype(np.float32) / np.iinfo(dtype).max
    np.testing.assert_array_equal(image.read_rgb_float(tmp_path / f"a{suffix}"), expected)


SAMPLING = (cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_422)


@pytest.mark.parametrize("sampling", [*SAMPLING, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444])
def test_jpeg_is_decoded_as_by_opencv(tmp_path, sampling):
    noise = np.random.default_rng(2).integers(0, 256, (33, 47, 3), dtype=np.uint8)
    path = tmp_path / "a.jpg"
    cv2.imwrite(str(path), noise, (cv2.IMWRITE_JPEG_QUALITY, 80, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, sampling))
    np.testing.assert_array_equal(image.read_rgb(path), cv2.imread(str(path))[..., ::-1])


@pytest.mark.parametrize("suffix", [".jpg", ".jpeg"])
def test_jpeg_is_encoded_as_by_opencv(tmp_path, suffix):
    smooth = cv2.GaussianBlur(np.random.default_rng(3).integers(0, 256, (40, 40, 3), dtype=np.uint8), (0, 0), 2)
    image.write_rgb(tmp_path / f"a{suffix}", smooth)
    other = cv2.imencode(".jpg", smooth[..., ::-1], (cv2.IMWRITE_JPEG_QUALITY, 92))[1]
    np.testing.assert_array_equal(image.read_rgb(tmp_path / f"a{suffix}"), cv2.imdecode(other, 1)[..., ::-1])


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".exr"])
def test_files_hold_no_date(tmp_path, pixels, suffix):
    """Otherwise the same pixels would give other bytes a second later."""
    path = tmp_path / f"a{suffix}"
    image.write_rgb(path, image.to_float(pixels) if suffix == ".exr" else pixels)
    first = path.read_bytes()
    image.write_rgb(path, image.to_float(pixels) if suffix == ".exr" else pixels)
    assert path.read_bytes() == first
    assert not oiio.ImageInput.open(str(path)).spec().get_string_attribute("DateTime")


def stored_values(path: Path) -> np.ndarray:
    """What an OpenEXR file holds, without any conversion."""
    return oiio.ImageInput.open(str(path)).read_image(oiio.FLOAT)


def test_exr_holds_linear_light_and_keeps_every_level(tmp_path):
    levels = np.arange(256, dtype=np.uint8).reshape(16, 16)
    image.write_gray(tmp_path / "a.exr", image.to_float(levels))
    np.testing.assert_allclose(stored_values(tmp_path / "a.exr")[..., 0], linear(levels / 255.0), rtol=6e-4, atol=1e-7)
    np.testing.assert_array_equal(image.read_gray(tmp_path / "a.exr"), levels)
    assert str(oiio.ImageInput.open(str(tmp_path / "a.exr")).spec().format) == "half"
    bright = np.array([[[0.25, 1.0, 1.5]]], dtype=np.float32)
    image.write_rgb(tmp_path / "b.exr", bright)
    np.testing.assert_allclose(image.read_rgb_float(tmp_path / "b.exr"), bright, rtol=5e-4)
    np.testing.assert_array_equal(image.read_rgb(tmp_path / "b.exr"), [[[64, 255, 255]]])


def write_exr(path: Path, values: np.ndarray, primaries: tuple[float, ...] = ()) -> None:
    """Linear values, as renderers write them: colour is premultiplied by alpha."""
    file, spec = oiio.ImageOutput.create(str(path)), oiio.ImageSpec(*values.shape[1::-1], values.shape[2], "half")
    if primaries:
        spec.attribute("chromaticities", "float[8]", primaries)
    file.open(str(path), spec)
    file.write_image(values.astype(np.float32))
    file.close()


def test_alpha_of_exr_is_divided_out(tmp_path):
    write_exr(tmp_path / "a.exr", np.array([[[0.5, 0.25, 0.0, 0.5], [0.0, 0.0, 0.0, 0.0]]]))
    half = int(np.rint(srgb_levels(np.float64(0.5))))
    np.testing.assert_array_equal(image.read_rgba(tmp_path / "a.exr"), [[[255, half, 0, 128], [0, 0, 0, 0]]])


@pytest.mark.parametrize(
    ("values", "message"),
    [(np.full((2, 2, 3), np.nan), "a.exr .* not finite"), (np.zeros((2, 2, 5)), "a.exr .* 5 chan")],
)
def test_exr_that_is_no_picture_is_refused(tmp_path, values, message):
    write_exr(tmp_path / "a.exr", values)
    with pytest.raises(UserError, match=message):
        image.read_rgb(tmp_path / "a.exr")


def test_exr_of_other_primaries_is_refused(tmp_path):
    write_exr(tmp_path / "a.exr", np.zeros((2, 2, 3)), (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290))
    assert image.read_rgb(tmp_path / "a.exr").shape == (2, 2, 3)
    write_exr(tmp_path / "a.exr", np.zeros((2, 2, 3)), (0.713, 0.293, 0.165, 0.83, 0.128, 0.044, 0.32168, 0.33767))
    with pytest.raises(UserError, match="a.exr has other primaries"):
        image.read_rgb(tmp_path / "a.exr")


@pytest.mark.parametrize("suffix", [".png", ".tif", ".webp"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_every_exif_orientation_is_applied(tmp_path, pixels, suffix, orientation):
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(pixels).save(tmp_path / f"a{suffix}", exif=exif, lossless=True)
    upright = np.asarray(ImageOps.exif_transpose(Image.open(tmp_path / f"a{suffix}")))
    np.testing.assert_array_equal(image.read_rgb(tmp_path / f"a{suffix}"), upright)
    np.testing.assert_array_equal(image.read_gray(tmp_path / f"a{suffix}"), np.rint(upright @ [0.299, 0.587, 0.114]))
    np.testing.assert_array_equal(image.read_rgba(tmp_path / f"a{suffix}")[..., :3], pixels)
    rgba = np.dstack([pixels, pixels[..., 0]])
    Image.fromarray(rgba).save(tmp_path / f"a{suffix}", exif=exif, lossless=True, exact=True)
    np.testing.assert_array_equal(image.read_alpha(tmp_path / f"a{suffix}"), upright[..., 0])


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


@pytest.mark.parametrize("suffix", [".jpg", ".tif"])
@pytest.mark.parametrize("profile", [b"junk", icc_profile(DISPLAY_P3, 0, 1.0, space=b"CMYK")])
def test_unusable_profile_is_reported(tmp_path, pixels, profile, suffix):
    Image.fromarray(pixels).save(tmp_path / f"a{suffix}", icc_profile=profile)
    for read in (image.read_rgb, image.read_rgb_float):
        with pytest.raises(UserError, match=f"colour profile of image .*a{suffix}"):
            read(tmp_path / f"a{suffix}")


def test_full_depth_reading_applies_the_profile(tmp_path, pixels):
    Image.fromarray(pixels).save(tmp_path / "a.png", icc_profile=P3_PROFILE)
    np.testing.assert_array_equal(
        image.to_uint8(image.read_rgb_float(tmp_path / "a.png")), image.read_rgb(tmp_path / "a.png")
    )


@pytest.mark.parametrize("suffix", [".png", ".tif"])
@pytest.mark.parametrize("shape", [(16, 16), (16, 16, 3)])
def test_sixteen_bits_become_eight(tmp_path, suffix, shape):
    deep = np.linspace(0, 65535, int(np.prod(shape))).reshape(shape).astype(np.uint16)
    cv2.imwrite(str(tmp_path / f"a{suffix}"), deep)
    rgb = image.read_rgb(tmp_path / f"a{suffix}")
    expected = np.repeat(deep[..., None], 3, axis=2) if deep.ndim == 2 else deep[..., ::-1]
    np.testing.assert_allclose(rgb, expected / 257.0, atol=0.5)


def test_floating_point_tiff_is_refused(tmp_path):
    cv2.imwrite(str(tmp_path / "a.tif"), np.zeros((4, 4, 3), np.float32), (cv2.IMWRITE_TIFF_COMPRESSION, 1))
    with pytest.raises(UserError, match="a.tif holds float32 values"):
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
    np.testing.assert_array_equal(image.to_uint16(np.array([-0.2, 0.5, 1.7])), [0, 32768, 65535])
    all_deep = np.arange(65536, dtype=np.uint16)
    np.testing.assert_array_equal(image.to_uint16(image.to_float(all_deep)), all_deep)
    np.testing.assert_array_equal(image.to_uint8(all_deep), np.rint(all_deep / 257.0))


@pytest.mark.parametrize("content", [b"", b"not an image"])
def test_damaged_file_is_named(tmp_path, content):
    (tmp_path / "broken.png").write_bytes(content)
    with pytest.raises(UserError, match="broken.png"):
        image.read_rgb(tmp_path / "broken.png")


def test_missing_file_is_named(tmp_path):
    with pytest.raises(UserError, match="nowhere.png"):
        image.read_gray(tmp_path / "nowhere.png")
    with pytest.raises(UserError, match="is a folder; name an image file"):
        image.read_gray(tmp_path)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".webp", ".exr"])
def test_truncated_file_is_named(tmp_path, suffix):
    noise = np.random.default_rng(4).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    path = tmp_path / f"cut{suffix}"
    if suffix == ".webp":
        Image.fromarray(noise).save(path)
    else:
        image.write_rgb(path, image.to_float(noise) if suffix == ".exr" else noise)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(UserError, match=f"cut{suffix} cannot be read .*replace or remove it"):
        image.read_rgb(path)


def test_padding_between_jpeg_segments_is_accepted(tmp_path, pixels):
    image.write_rgb(tmp_path / "a.jpg", pixels)
    expected, data = image.read_rgb(tmp_path / "a.jpg"), (tmp_path / "a.jpg").read_bytes()
    place = data.index(b"\xff\xdb")
    (tmp_path / "a.jpg").write_bytes(data[:place] + bytes(3) + data[place:])
    np.testing.assert_array_equal(image.read_rgb(tmp_path / "a.jpg"), expected)


def test_damaged_exif_of_webp_is_ignored(tmp_path, pixels):
    Image.fromarray(pixels).save(tmp_path / "a.webp", exif=b"Exif\0\0nonsense", lossless=True)
    np.testing.assert_array_equal(image.read_rgb(tmp_path / "a.webp"), pixels)


def test_a_header_that_claims_a_huge_image_is_refused(tmp_path):
    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 60000, 60000, 8, 2, 0, 0, 0))
    body = chunk(b"IDAT", zlib.compress(bytes(1000))) + chunk(b"IEND", b"")
    (tmp_path / "huge.png").write_bytes(b"\x89PNG\r\n\x1a\n" + header + body)
    with pytest.raises(UserError, match="huge.png .*size"):
        image.read_rgb(tmp_path / "huge.png")


def test_a_png_named_jpg_is_read(tmp_path, pixels):
    image.write_rgb(tmp_path / "a.png", pixels)
    np.testing.assert_array_equal(image.read_rgb((tmp_path / "a.png").rename(tmp_path / "b.jpg")), pixels)


@pytest.mark.parametrize(
    ("name", "dtype", "message"),
    [
        ("a.heic", np.uint8, "a.heic cannot be written as .heic; choose one of .png"),
        ("a.jpg", np.uint16, "a.jpg cannot hold uint16"),
        ("a.png", np.float32, "a.png cannot hold float32"),
        ("a.exr", np.uint8, "a.exr cannot hold uint8"),
    ],
)
def test_what_a_format_cannot_hold_is_refused(tmp_path, name, dtype, message):
    with pytest.raises(UserError, match=message):
        image.write_rgb(tmp_path / name, np.zeros((2, 2, 3), dtype))
    assert not (tmp_path / name).exists()


def test_alpha_is_not_written_where_there_is_none(tmp_path):
    with pytest.raises(UserError, match="a.jpg cannot hold alpha"):
        image.write_rgba(tmp_path / "a.jpg", np.zeros((2, 2, 4), np.uint8))


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".exr"])
def test_a_full_disk_raises_and_does_not_end_the_process(tmp_path, suffix):
    (tmp_path / f"a{suffix}").symlink_to("/dev/full")
    pixels = np.zeros((64, 64, 3), np.float32 if suffix == ".exr" else np.uint8)
    with pytest.raises(OSError, match="No space left"):
        image.write_rgb(tmp_path / f"a{suffix}", pixels)


def test_png_bytes_are_a_png(pixels):
    for colour in (pixels, np.dstack([pixels, pixels[..., :1]])):
        decoded = cv2.imdecode(np.frombuffer(image.png_bytes(colour), np.uint8), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(decoded[..., [2, 1, 0, 3][: colour.shape[2]]], colour)
