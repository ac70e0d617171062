"""What containers say about their pictures, and files that are damaged."""

from pathlib import Path

import av
import numpy as np
import pytest

from pipeline.capture import video
from pipeline.core.progress import take_warnings
from tests.capture.video_files import ramp, select_all, write_video

IDENTITY = (0x10000).to_bytes(4, "big") + bytes(12) + (0x10000).to_bytes(4, "big") + bytes(12)
IDENTITY += (0x40000000).to_bytes(4, "big")

TURNS = [
    (1, 0, 0, 1),
    (0, 1, -1, 0),
    (-1, 0, 0, -1),
    (0, -1, 1, 0),
    (-1, 0, 0, 1),
    (1, 0, 0, -1),
    (0, 1, 1, 0),
    (0, -1, -1, 0),
]


@pytest.mark.parametrize("turn", TURNS)
def test_turns_and_mirrors_of_the_container_are_honoured(tmp_path, turn):
    """The track header's matrix (a b; c d) sends the corner (x, y) to (a x + c y, b x + d y)."""
    a, b, c, d = turn
    corners = {(-1, -1): 30, (1, -1): 90, (-1, 1): 150, (1, 1): 210}
    picture = ramp(0)
    for (x, y), level in corners.items():
        picture[24 * (y > 0) : 24 * (y > 0) + 24, 32 * (x > 0) : 32 * (x > 0) + 32] = level
    write_video(tmp_path / "a.mp4", [picture] * 3)
    data = (tmp_path / "a.mp4").read_bytes()
    at = data.index(IDENTITY, data.index(b"tkhd"))
    words = [word & 0xFFFFFFFF for word in (a << 16, b << 16, 0, c << 16, d << 16, 0, 0, 0, 0x40000000)]
    matrix = b"".join(word.to_bytes(4, "big") for word in words)
    (tmp_path / "turned.mp4").write_bytes(data[:at] + matrix + data[at + 36 :])
    frame = next(video.read_frames(video.open_frame_source(tmp_path / "turned.mp4"), select_all, 1000))
    height, width = frame.rgb.shape[:2]
    assert (width, height) == ((64, 48) if a else (48, 64))
    for (x, y), level in corners.items():
        right, down = a * x + c * y > 0, b * x + d * y > 0
        quarter = frame.rgb[height // 2 * down :][: height // 2, width // 2 * right :][:, : width // 2]
        assert np.median(quarter) == pytest.approx(level, abs=4)


def test_untagged_high_definition_has_the_matrix_of_high_definition(tmp_path):
    """Players take BT.709 for it; a red encoded by its equation."""
    red, green, blue = np.array([200, 60, 50]) / 255.0
    luma = 0.2126 * red + 0.7152 * green + 0.0722 * blue
    levels = np.rint([16 + 219 * luma, 128 + 224 * (blue - luma) / 1.8556, 128 + 224 * (red - luma) / 1.5748])
    planes = np.repeat(levels, [720 * 64, 360 * 32, 360 * 32]).reshape(1080, 64).astype(np.uint8)
    with av.open(str(tmp_path / "a.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=25, options={"crf": "1", "bf": "0"})
        stream.width, stream.height, stream.pix_fmt = 64, 720, "yuv420p"
        container.mux(stream.encode(av.VideoFrame.from_ndarray(planes, format="yuv420p")))
        container.mux(stream.encode(None))
    frame = next(video.read_frames(video.open_frame_source(tmp_path / "a.mp4"), select_all, 1000))
    np.testing.assert_allclose(frame.rgb.mean(axis=(0, 1)), [200, 60, 50], atol=2.5)


def test_interlaced_frames_show_one_time_only(tmp_path):
    """Fields of two times, one dark and one bright: a comb."""
    comb = ramp(60)
    comb[1::2] = 200
    with av.open(str(tmp_path / "a.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=25, options={"crf": "4", "bf": "0", "x264-params": "tff=1"})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv444p"
        for _ in range(3):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(comb, format="rgb24")))
        container.mux(stream.encode(None))
    frame = next(video.read_frames(video.open_frame_source(tmp_path / "a.mp4"), select_all, 1000))
    assert np.abs(frame.rgb[:-1].astype(int) - 60).max() < 8


def test_a_damaged_packet_costs_its_own_frames_only(tmp_path):
    """Every picture is a key frame here, so that a damaged one spoils no other."""
    path = tmp_path / "a.mp4"
    pictures = [np.random.default_rng(k).integers(0, 255, (48, 64, 3)).astype(np.uint8) for k in range(20)]
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mjpeg", rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuvj420p"
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode(None))
    data = bytearray(path.read_bytes())
    with av.open(str(path)) as container:
        packets = [packet for packet in container.demux(container.streams.video[0]) if packet.size]
        start, size = packets[10].pos, packets[10].size
    data[start : start + size] = bytes(size)
    path.write_bytes(bytes(data))
    take_warnings()
    frames = list(video.read_frames(video.open_frame_source(path), select_all, 1000))
    assert len(frames) == 19
    assert frames[-1].time_s == pytest.approx(19 / 25)
    assert any("is damaged: about 1 frames" in text for text in take_warnings())


def test_an_incomplete_file_is_named(tmp_path):
    """As of an interrupted copy whose index is at the front."""
    write_video(
        tmp_path / "a.mp4", [np.random.default_rng(k).integers(0, 255, (48, 64, 3)).astype(np.uint8) for k in range(40)]
    )
    with (
        av.open(str(tmp_path / "a.mp4")) as source,
        av.open(str(tmp_path / "b.mp4"), "w", options={"movflags": "faststart"}) as container,
    ):
        stream = container.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(source.streams.video[0]):
            if packet.dts is not None:
                packet.stream = stream
                container.mux(packet)
    data = (tmp_path / "b.mp4").read_bytes()
    (tmp_path / "b.mp4").write_bytes(data[: len(data) // 2])
    take_warnings()
    source = video.open_frame_source(tmp_path / "b.mp4")
    assert 5 < source.n_frames < 35
    assert any("of its 40 frames are there" in text for text in take_warnings())


def test_names_with_superscripts_have_an_order(tmp_path):
    assert video.natural_sort_key(Path("a1²0.jpg"))
