"""Decoded pictures against what players show, colour equations and pictures made by hand."""

from fractions import Fraction

import av
import numpy as np
import pytest

from pipeline.capture import video
from pipeline.capture.video_picture import replace_second_field, to_upright_rgb
from tests.capture.video_files import IDENTITY, ramp, select_all, write_video


@pytest.mark.parametrize(
    ("matrix", "corners"),
    [
        ((1, 0, 0, 1), (220, 120, 70, 30)),
        ((-1, 0, 0, 1), (120, 220, 30, 70)),
        ((1, 0, 0, -1), (70, 30, 220, 120)),
        ((-1, 0, 0, -1), (30, 70, 120, 220)),
        ((0, 1, -1, 0), (70, 220, 30, 120)),
        ((0, -1, 1, 0), (120, 30, 220, 70)),
        ((0, 1, 1, 0), (220, 70, 120, 30)),
        ((0, -1, -1, 0), (30, 120, 70, 220)),
    ],
)
def test_all_orientations_are_those_of_ffmpeg(tmp_path, matrix, corners):
    """The file's matrix (a b; c d) and the four quarters of the picture that ffmpeg 9's autorotation makes of it."""
    picture = ramp(30)
    picture[:24, :32], picture[:24, 32:], picture[24:, :32] = 220, 120, 70
    write_video(tmp_path / "a.mp4", [picture] * 2)
    data = (tmp_path / "a.mp4").read_bytes()
    at = data.index(IDENTITY, data.index(b"tkhd"))
    a, b, c, d = ((value * 0x10000).to_bytes(4, "big", signed=True) for value in matrix)
    stored = a + b + bytes(4) + c + d + bytes(12) + (0x40000000).to_bytes(4, "big")
    (tmp_path / "turned.mp4").write_bytes(data[:at] + stored + data[at + 36 :])
    rgb = next(video.read_frames(video.open_frame_source(tmp_path / "turned.mp4"), select_all, 1000)).rgb
    assert rgb.shape == ((48, 64, 3) if matrix[0] else (64, 48, 3))
    height, width = rgb.shape[0] // 2, rgb.shape[1] // 2
    quarters = rgb[:height, :width], rgb[:height, width:], rgb[height:, :width], rgb[height:, width:]
    assert [round(float(quarter[6:-6, 6:-6].mean())) for quarter in quarters] == pytest.approx(corners, abs=3)


def coded_picture(rgb: tuple[int, int, int], height: int, width: int, weights: tuple[float, float]) -> av.VideoFrame:
    """A picture without tags in one colour; weights: of red and blue in luma."""
    (red, green, blue), (red_weight, blue_weight) = np.array(rgb) / 255, weights
    luma = red_weight * red + (1 - red_weight - blue_weight) * green + blue_weight * blue
    chroma = (blue - luma) / (2 - 2 * blue_weight), (red - luma) / (2 - 2 * red_weight)
    levels = np.rint([16 + 219 * luma, 128 + 224 * chroma[0], 128 + 224 * chroma[1]])
    planes = np.repeat(levels, [height * width, height * width // 4, height * width // 4])
    return av.VideoFrame.from_ndarray(planes.reshape(-1, width).astype(np.uint8), format="yuv420p")


BT_601, BT_709, BT_2020 = (0.299, 0.114), (0.2126, 0.0722), (0.2627, 0.0593)


@pytest.mark.parametrize(
    ("height", "width", "weights"),
    [(720, 1280, BT_709), (1280, 720, BT_709), (578, 480, BT_709), (576, 720, BT_601), (480, 640, BT_601)],
)
@pytest.mark.parametrize("colour", [(200, 60, 50), (40, 160, 70), (225, 175, 150)])
def test_the_matrix_of_a_file_without_one_follows_from_its_size(height, width, weights, colour):
    rgb, _ = to_upright_rgb(coded_picture(colour, height, width, weights), None)
    np.testing.assert_allclose(rgb.mean(axis=(0, 1)), colour, atol=2.5)


def test_a_named_matrix_and_full_range_jpeg_pictures_stay_as_they_are():
    picture = coded_picture((200, 60, 50), 720, 1280, BT_601)
    picture.colorspace = 6
    np.testing.assert_allclose(to_upright_rgb(picture, None)[0].mean(axis=(0, 1)), (200, 60, 50), atol=2.5)
    full_range = np.repeat(np.array([100, 90, 170], np.uint8), [1280 * 720, 640 * 360, 640 * 360]).reshape(-1, 1280)
    rgb, _ = to_upright_rgb(av.VideoFrame.from_ndarray(full_range, format="yuvj420p"), None)
    jfif = 100 + 1.402 * 42, 100 - 0.344136 * -38 - 0.714136 * 42, 100 + 1.772 * -38
    np.testing.assert_allclose(rgb.mean(axis=(0, 1)), jfif, atol=2.5)


def test_high_dynamic_range_without_a_matrix_is_bt_2020():
    named, unnamed = (coded_picture((190, 90, 80), 64, 64, BT_2020) for _ in range(2))
    for picture in (named, unnamed):
        picture.color_trc, picture.color_primaries = 18, 9
    named.colorspace = 9
    (expected, _), (signal, to_srgb) = (to_upright_rgb(picture, None) for picture in (named, unnamed))
    np.testing.assert_array_equal(signal, expected)
    np.testing.assert_allclose(signal.mean(axis=(0, 1)) / 257, (190, 90, 80), atol=2.5)
    assert to_srgb(signal).dtype == np.uint8


def test_rows_of_the_second_field_are_means_of_their_neighbours():
    rows = np.array([[10, 255], [99, 99], [20, 255], [99, 99], [31, 0], [99, 99]], np.uint8)
    replace_second_field(rows)
    assert rows.tolist() == [[10, 255], [15, 255], [20, 255], [26, 128], [31, 0], [31, 0]]
    odd = np.array([[7], [0], [9]], np.uint16)
    replace_second_field(odd)
    assert odd.tolist() == [[7], [8], [9]]


@pytest.mark.parametrize("deep", [False, True])
def test_interlaced_video_has_no_combs(tmp_path, deep):
    """A red bar on grey that moves by 8 pixels between the two fields; the first field is what is seen."""
    still = np.full((96, 128, 3), (90, 90, 90), np.uint8)
    still[:, 40:72] = (200, 60, 60)
    moved = np.roll(still, 8, axis=1)
    pixel_format = "yuv420p10le" if deep else "yuv420p"
    frames = [av.VideoFrame.from_ndarray(picture, format="rgb24") for picture in (still, moved)]
    fields = [frame.reformat(format=pixel_format).to_ndarray() for frame in frames]
    woven = fields[0].copy()
    woven[1:96:2] = fields[1][1:96:2]
    shape = (2, 48, 64)
    for_chroma = woven[96:].reshape(shape)
    for_chroma[:, 1::2] = fields[1][96:].reshape(shape)[:, 1::2]
    path = tmp_path / "a.mkv"
    with av.open(str(path), "w") as container:
        options = {"crf": "1", "bf": "0", "x264-params": "interlaced=1:tff=1"}
        stream = container.add_stream("libx264", rate=25, options=options)
        stream.width, stream.height, stream.pix_fmt = 128, 96, pixel_format
        stream.codec_context.time_base = Fraction(1, 25)
        for k in range(3):
            coded = av.VideoFrame.from_ndarray(woven, format=pixel_format)
            coded.pts = k
            container.mux(stream.encode(coded))
        container.mux(stream.encode(None))
    rgbs = [frame.rgb for frame in video.read_frames(video.open_frame_source(path), select_all, 1000)]
    assert len(rgbs) == 3
    for rgb in rgbs:
        np.testing.assert_allclose(rgb.astype(int), np.broadcast_to(rgb[:1].astype(int), rgb.shape), atol=6)
        assert np.abs(rgb[:, 46:66].mean(axis=(0, 1)) - (200, 60, 60)).max() < 8
        assert np.abs(rgb[:, 76:].mean(axis=(0, 1)) - 90).max() < 4
