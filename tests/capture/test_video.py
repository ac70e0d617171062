"""Recordings written here, with container features set by hand, must come back as a viewer shows them."""

import gc
from fractions import Fraction

import av
import cv2
import numpy as np
import pytest

from pipeline.capture import video
from pipeline.capture.exif_focal import metadata_focal_px
from pipeline.core.errors import UserError
from pipeline.core.progress import take_warnings
from pipeline.io.hdr import BT_2020, HLG, to_srgb
from pipeline.io.image import write_rgb
from tests.capture.video_files import ramp, select_all, write_video


def test_frames_come_in_order_with_index_and_time(tmp_path):
    write_video(tmp_path / "a.mp4", [ramp(20 * k) for k in range(10)])
    source = video.open_frame_source(tmp_path / "a.mp4")
    assert (source.n_frames, source.fps, source.files) == (10, 25.0, ())
    frames = list(video.read_frames(source, lambda index: index % 3 == 0, 1000))
    assert [frame.index for frame in frames] == [0, 3, 6, 9]
    assert [frame.time_s for frame in frames] == pytest.approx([0, 0.12, 0.24, 0.36])
    assert [round(frame.rgb.mean() / 20) for frame in frames] == [0, 3, 6, 9]


def test_pictures_that_were_read_stay_no_longer_in_memory(tmp_path):
    write_video(tmp_path / "a.mp4", [ramp(10 * k) for k in range(20)])
    source = video.open_frame_source(tmp_path / "a.mp4")

    def frames_in_memory() -> int:
        return sum(isinstance(thing, av.VideoFrame) for thing in gc.get_objects())

    gc.collect()
    before = frames_in_memory()
    gc.disable()
    try:
        for _ in video.read_frames(source, select_all, 1000):
            pass
        left = frames_in_memory() - before
    finally:
        gc.enable()
    assert left <= 2


def test_variable_frame_rate_keeps_its_times(tmp_path):
    times = [0, 1, 4, 5, 25]
    write_video(tmp_path / "a.mp4", [ramp(40 * k) for k in range(5)], times)
    frames = list(video.read_frames(video.open_frame_source(tmp_path / "a.mp4"), select_all, 1000))
    assert [frame.time_s for frame in frames] == pytest.approx([t / 25 for t in times])


def test_a_stamp_that_goes_back_counts_one_frame_later(tmp_path):
    """Matroska keeps milliseconds in two bytes behind each block's track number; the fourth frame's become 40."""
    write_video(tmp_path / "a.mkv", [ramp(20 * k) for k in range(6)])
    data = bytearray((tmp_path / "a.mkv").read_bytes())
    at = data.index(b"\x81" + (120).to_bytes(2, "big") + b"\0")
    data[at + 1 : at + 3] = (40).to_bytes(2, "big")
    (tmp_path / "odd.mkv").write_bytes(data)
    frames = list(video.read_frames(video.open_frame_source(tmp_path / "odd.mkv"), select_all, 1000))
    assert [frame.time_s for frame in frames] == pytest.approx([k / 25 for k in range(6)])


def test_a_video_without_stamps_runs_at_its_rate(tmp_path):
    write_video(tmp_path / "a.h264", [ramp(20 * k) for k in range(6)])
    frames = list(video.read_frames(video.open_frame_source(tmp_path / "a.h264"), select_all, 1000))
    assert [frame.time_s for frame in frames] == pytest.approx([k / 25 for k in range(6)])


@pytest.mark.parametrize(
    ("matrix", "red_weight", "blue_weight"), [(1, 0.2126, 0.0722), (6, 0.299, 0.114), (9, 0.2627, 0.0593)]
)
def test_colours_are_read_with_the_matrix_that_the_file_names(tmp_path, matrix, red_weight, blue_weight):
    """ITU-R BT.709, BT.601 and BT.2020 (H.273's numbers 1, 6, 9), encoded here by their own equations."""
    colours = np.array([[200, 60, 50], [40, 160, 70], [60, 80, 190], [225, 175, 150]])
    path = tmp_path / "a.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=25, options={"crf": "1", "bf": "0"})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stream.codec_context.colorspace = matrix
        stream.codec_context.color_range = 1  # 16 to 235
        for red, green, blue in colours / 255.0:
            luma = red_weight * red + (1.0 - red_weight - blue_weight) * green + blue_weight * blue
            chroma = (blue - luma) / (2.0 - 2.0 * blue_weight), (red - luma) / (2.0 - 2.0 * red_weight)
            levels = np.rint([16 + 219 * luma, 128 + 224 * chroma[0], 128 + 224 * chroma[1]])
            planes = np.repeat(levels, [48 * 64, 24 * 32, 24 * 32]).reshape(72, 64).astype(np.uint8)
            frame = av.VideoFrame.from_ndarray(planes, format="yuv420p")
            frame.colorspace, frame.color_range = matrix, 1
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    frames = list(video.read_frames(video.open_frame_source(path), select_all, 1000))
    shown = np.array([frame.rgb.mean(axis=(0, 1)) for frame in frames])
    np.testing.assert_allclose(shown, colours, atol=2.5)


def test_hdr_is_shown_as_srgb(tmp_path):
    """HLG with BT.2020's colours, as phones record it: 75 % of the signal is white (BT.2408), 38 % a dark grey."""
    levels = np.array([[0.75, 0.75, 0.75], [0.38, 0.38, 0.38], [0.6, 0.3, 0.3]])
    path = tmp_path / "a.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx265", rate=25, options={"crf": "1", "x265-params": "log-level=none"})
        stream.width, stream.height, stream.pix_fmt = 64, 64, "yuv420p10le"
        codec = stream.codec_context
        codec.colorspace, codec.color_primaries, codec.color_trc, codec.color_range = 9, 9, 18, 1
        for red, green, blue in levels:
            luma = 0.2627 * red + 0.6780 * green + 0.0593 * blue
            parts = np.array([luma, (blue - luma) / 1.8814, (red - luma) / 1.4746])
            coded = np.rint(4 * (np.array([16, 128, 128]) + np.array([219, 224, 224]) * parts))
            planes = np.repeat(coded, [64 * 64, 32 * 32, 32 * 32]).reshape(96, 64).astype(np.uint16)
            frame = av.VideoFrame.from_ndarray(planes, format="yuv420p10le")
            frame.colorspace, frame.color_primaries, frame.color_trc, frame.color_range = 9, 9, 18, 1
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    frames = list(video.read_frames(video.open_frame_source(path), select_all, 1000))
    assert all(frame.rgb.dtype == np.uint8 for frame in frames)
    shown = np.array([frame.rgb.mean(axis=(0, 1)) for frame in frames])
    truth = [to_srgb(np.rint(65535 * level).astype(np.uint16)[None, None], HLG, BT_2020)[0, 0] for level in levels]
    np.testing.assert_allclose(shown, np.array(truth, dtype=float), atol=3)
    assert shown[0].min() > 250
    assert shown[1] == pytest.approx([101, 101, 101], abs=3)


def test_frames_that_an_edit_list_hides_are_not_counted(tmp_path):
    """As a phone or `ffmpeg -ss` cuts a clip: the pictures back to the last key frame are in the file, before zero."""
    write_video(tmp_path / "a.mp4", [ramp(20 * k) for k in range(12)], list(range(-4, 8)))
    source = video.open_frame_source(tmp_path / "a.mp4")
    frames = list(video.read_frames(source, select_all, 1000))
    assert source.n_frames == len(frames) == 8
    assert [round(frame.rgb.mean() / 20) for frame in frames] == list(range(4, 12))
    assert [frame.time_s for frame in frames] == pytest.approx([k / 25 for k in range(8)])


def test_wide_pixels_are_made_square(tmp_path):
    write_video(tmp_path / "a.mp4", [ramp(90)] * 3, aspect=Fraction(4, 3))
    frame = next(video.read_frames(video.open_frame_source(tmp_path / "a.mp4"), select_all, 1000))
    assert frame.rgb.shape == (48, 85, 3)


def test_chroma_is_interpolated(tmp_path):
    """Along a diagonal edge between two colours, repeated chroma samples would leave equal 2 x 2 blocks."""
    rows, columns = np.mgrid[:64, :64]
    picture = np.where((rows + columns < 64)[..., None], (200, 60, 60), (60, 120, 60)).astype(np.uint8)
    picture = cv2.GaussianBlur(picture, (0, 0), 2)
    write_video(tmp_path / "a.mp4", [picture] * 3)
    rgb = next(video.read_frames(video.open_frame_source(tmp_path / "a.mp4"), select_all, 1000)).rgb.astype(int)
    redness = rgb[..., 0] - rgb[..., 1]
    band = np.abs(rows + columns - 64) < 6
    steps = np.abs(np.diff(redness, axis=1))[band[:, 1:]]
    assert (steps > 1).mean() > 0.99


def test_large_frames_are_shrunk_with_their_factor(tmp_path):
    write_video(tmp_path / "a.mp4", [ramp(90, 100, 200)] * 2)
    frame = next(video.read_frames(video.open_frame_source(tmp_path / "a.mp4"), select_all, 80))
    assert frame.rgb.shape == (40, 80, 3)
    assert frame.scale == pytest.approx(0.4)


def test_thumbnails_of_a_video_and_of_images_are_grey_means(tmp_path):
    halves = np.concatenate([ramp(60, 96, 64), ramp(180, 96, 64)], axis=1)
    write_video(tmp_path / "a.mp4", [halves, halves[:, ::-1], halves])
    (tmp_path / "images").mkdir()
    for k in range(3):
        write_rgb(tmp_path / "images" / f"{k}.png", halves if k != 1 else halves[:, ::-1])
    for path in (tmp_path / "a.mp4", tmp_path / "images"):
        index, gray = video.read_thumbnails(video.open_frame_source(path), {0, 1}.__contains__, 32)
        assert index.tolist() == [0, 1]
        assert gray.shape == (2, 24, 32)
        assert gray[0, :, :14].std() < 2
        assert int(gray[0, 0, 30]) - int(gray[0, 0, 1]) == pytest.approx(120, abs=6)
        assert (np.abs(gray[0].astype(int) - gray[1, :, ::-1]) < 4).all()


def test_image_folder_in_natural_order_at_thirty_a_second(tmp_path):
    for k in (1, 2, 10):
        write_rgb(tmp_path / f"shot{k}.png", ramp(20 * k))
    (tmp_path / "notes.txt").write_text("x")
    source = video.open_frame_source(tmp_path)
    assert [path.name for path in source.files] == ["shot1.png", "shot2.png", "shot10.png"]
    frames = list(video.read_frames(source, select_all, 1000))
    assert [int(frame.rgb.mean()) for frame in frames] == [20, 40, 200]
    assert [frame.time_s for frame in frames] == pytest.approx([0, 1 / 30, 2 / 30])
    slow = video.open_frame_source(tmp_path, image_fps=12.5)
    assert slow.fps == 12.5
    assert [frame.time_s for frame in video.read_frames(slow, select_all, 1000)] == pytest.approx([0, 0.08, 0.16])


def test_the_size_of_pictures_is_that_which_a_viewer_shows(tmp_path):
    write_video(tmp_path / "a.mp4", [ramp(90)] * 3, aspect=Fraction(4, 3))
    assert video.image_size_px(video.open_frame_source(tmp_path / "a.mp4")) == (85, 48)
    (tmp_path / "images").mkdir()
    write_rgb(tmp_path / "images" / "0.png", ramp(9, 20, 30))
    assert video.image_size_px(video.open_frame_source(tmp_path / "images")) == (30, 20)


def test_folder_with_a_video_or_a_folder_of_frames(tmp_path):
    (tmp_path / "v").mkdir()
    write_video(tmp_path / "v" / "clip.mp4", [ramp(9)] * 3)
    assert video.open_frame_source(tmp_path / "v").path == tmp_path / "v" / "clip.mp4"
    (tmp_path / "i" / "frames").mkdir(parents=True)
    write_rgb(tmp_path / "i" / "frames" / "0.png", ramp(9))
    assert video.open_frame_source(tmp_path / "i").path == tmp_path / "i" / "frames"


def test_truncated_video_gives_a_warning(tmp_path):
    rng = np.random.default_rng(0)
    pictures = [rng.integers(0, 255, (64, 64, 3), dtype=np.uint8) for _ in range(12)]
    write_video(tmp_path / "a.mkv", pictures)
    data = (tmp_path / "a.mkv").read_bytes()
    (tmp_path / "cut.mkv").write_bytes(data[: len(data) * 2 // 3])
    source = video.open_frame_source(tmp_path / "cut.mkv")
    assert 4 <= len(list(video.read_frames(source, select_all, 1000))) < 12
    take_warnings()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda path: None, "does not exist"),
        (lambda path: path.mkdir(), "is empty"),
        (lambda path: (path.mkdir(), (path / "a.txt").write_text("x")), "neither a video nor images"),
        (lambda path: (path.mkdir(), (path / "IMG_1.HEIC").touch()), "HEIC images, .* save them as JPEG"),
        (lambda path: path.write_text("hello"), "cannot be read as a video"),
        (lambda path: path.write_bytes(b""), "cannot be read as a video"),
        (lambda path: (path.mkdir(), (path / "a.mp4").touch(), (path / "b.mp4").touch()), "2 videos"),
    ],
)
def test_what_is_no_recording_is_refused(tmp_path, make, message):
    make(tmp_path / "in")
    with pytest.raises(UserError, match=message):
        video.open_frame_source(tmp_path / "in")


def test_sound_alone_is_refused(tmp_path):
    with av.open(str(tmp_path / "a.wav"), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=8000)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), layout="mono")
        frame.rate = 8000
        container.mux(stream.encode(frame))
    with pytest.raises(UserError, match="no video track"):
        video.open_frame_source(tmp_path / "a.wav")


@pytest.mark.parametrize(
    "text",
    [
        "#EXTM3U\n#EXT-X-TARGETDURATION:10\n#EXTINF:10,\nsecret.ts\n#EXT-X-ENDLIST\n",
        "ffconcat version 1.0\nfile secret.ts\n",
    ],
)
def test_files_that_name_other_files_are_refused(tmp_path, text):
    with av.open(str(tmp_path / "secret.ts"), "w", format="mpegts") as container:
        stream = container.add_stream("libx264", rate=24)
        stream.width, stream.height, stream.pix_fmt = 64, 64, "yuv420p"
        for _ in range(24):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.zeros((64, 64, 3), np.uint8), format="rgb24")))
        container.mux(stream.encode())
    assert video.open_frame_source(tmp_path / "secret.ts").n_frames == 24
    (tmp_path / "a.mp4").write_text(text)
    with pytest.raises(UserError, match=r"a\.mp4 cannot be read as a video"):
        video.open_frame_source(tmp_path / "a.mp4")


def test_a_title_that_is_not_utf8_does_not_matter(tmp_path):
    with av.open(str(tmp_path / "a.avi"), "w") as container:
        container.metadata["title"] = "Title of my film"
        stream = container.add_stream("mjpeg", rate=24)
        stream.width, stream.height, stream.pix_fmt = 64, 64, "yuvj420p"
        for _ in range(3):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.zeros((64, 64, 3), np.uint8), format="rgb24")))
        container.mux(stream.encode())
    content = (tmp_path / "a.avi").read_bytes()
    assert b"Title of my film" in content
    (tmp_path / "a.avi").write_bytes(content.replace(b"Title of my film", "Titel: \xfcber mich".encode("latin1")[:16]))
    source = video.open_frame_source(tmp_path / "a.avi")
    assert len(list(video.read_frames(source, select_all, 1000))) == 3
    assert metadata_focal_px(source, 64, 64) is None


def test_a_video_whose_size_changes_is_refused(tmp_path):
    for name, height, width in (("a.ts", 48, 64), ("b.ts", 64, 48)):
        write_video(tmp_path / name, [ramp(90, height, width)] * 8)
    (tmp_path / "both.ts").write_bytes((tmp_path / "a.ts").read_bytes() + (tmp_path / "b.ts").read_bytes())
    source = video.open_frame_source(tmp_path / "both.ts")
    with pytest.raises(UserError, match=r"frame \d+ of .*both.ts has another shape"):
        video.read_thumbnails(source, select_all, 32)
    with pytest.raises(UserError, match=r"frame \d+ of .*both.ts is 48x64"):
        list(video.read_frames(source, select_all, 1000))


def test_unreadable_and_odd_sized_images_are_named(tmp_path):
    write_rgb(tmp_path / "a.png", ramp(9))
    (tmp_path / "b.png").write_bytes(b"nothing")
    with pytest.raises(UserError, match="b.png"):
        list(video.read_frames(video.open_frame_source(tmp_path), select_all, 1000))
    write_rgb(tmp_path / "b.png", ramp(9, 20, 20))
    with pytest.raises(UserError, match="b.png is 20x20"):
        list(video.read_frames(video.open_frame_source(tmp_path), select_all, 1000))
