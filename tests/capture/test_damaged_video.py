"""Files that were cut, damaged or assembled by hand: what is there is read, and the user is told what is not."""

from pathlib import Path

import av
import numpy as np
import pytest

from pipeline.capture import video
from pipeline.capture.video import natural_sort_key, open_frame_source, read_frames
from pipeline.core.errors import UserError
from pipeline.core.progress import take_warnings
from pipeline.io.image import write_rgb
from tests.capture.video_files import ramp, select_all, write_video

N_FRAMES = 24


@pytest.fixture(autouse=True)
def without_warnings():
    take_warnings()
    yield
    take_warnings()


def write_steps(path: Path, codec: str = "libx264", faststart: bool = False) -> list[tuple[int, int]]:
    """A video whose grey level is ten times the index; return places and sizes of its packets."""
    with av.open(str(path), "w", options={"movflags": "+faststart"} if faststart else {}) as container:
        stream = container.add_stream(codec, rate=25, options={"bf": "0"})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuvj420p" if codec == "mjpeg" else "yuv420p"
        noise = np.random.default_rng(0).integers(-6, 7, (N_FRAMES, 48, 64, 1)).repeat(3, axis=3)
        for k in range(N_FRAMES):
            picture = np.clip(10 * k + 6 + noise[k], 0, 255).astype(np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode(None))
    with av.open(str(path)) as container:
        return [(packet.pos, packet.size) for packet in container.demux(video=0) if packet.size]


@pytest.mark.parametrize(("codec", "suffix"), [("libx264", ".mp4"), ("mjpeg", ".avi")])
@pytest.mark.parametrize("damaged", [[0], [12], [9, 10, 17]])
def test_frames_after_a_damaged_one_are_read_and_keep_their_index(tmp_path, codec, suffix, damaged):
    path = tmp_path / f"a{suffix}"
    places = write_steps(path, codec)
    data = bytearray(path.read_bytes())
    for k in damaged:
        at, size = places[k]
        data[at : at + size] = b"\xff" * size
    path.write_bytes(data)
    source = open_frame_source(path)
    passes = [[(f.index, round((f.rgb.mean() - 6) / 10)) for f in read_frames(source, select_all, 99)] for _ in "ab"]
    kept = [k for k in range(N_FRAMES) if k not in damaged]
    assert passes[0] == passes[1]
    # H.264 conceals what depends on a lost key frame; its levels may be off.
    assert [index for index, _ in passes[0]] == kept
    assert all(index == level for index, level in passes[0]) or damaged == [0]
    (message,) = take_warnings()
    assert f"a{suffix} is damaged: {len(damaged)} of {N_FRAMES} frames are missing" in message
    assert video.image_size_px(source) == (64, 48)
    index, _ = video.read_thumbnails(source, select_all, 32)
    assert index.tolist() == kept


def test_frames_behind_the_end_of_a_cut_file_are_told(tmp_path):
    places = write_steps(tmp_path / "a.mp4", faststart=True)
    data = (tmp_path / "a.mp4").read_bytes()
    (tmp_path / "cut.mp4").write_bytes(data[: places[14][0]])
    source = open_frame_source(tmp_path / "cut.mp4")
    (message,) = take_warnings()
    assert f"cut.mp4 is incomplete: its index lists {N_FRAMES} frames, it holds 14; copy it again" in message
    assert [frame.index for frame in read_frames(source, select_all, 99)] == list(range(14))
    open_frame_source(tmp_path / "a.mp4")
    assert take_warnings() == []


def test_a_clip_that_an_edit_list_shortens_is_complete(tmp_path):
    """The edit's duration (milliseconds, behind version, flags and count) becomes 0.4 s."""
    write_steps(tmp_path / "a.mp4")
    data = bytearray((tmp_path / "a.mp4").read_bytes())
    at = data.index(b"elst") + 12
    data[at : at + 4] = (400).to_bytes(4, "big")
    (tmp_path / "edit.mp4").write_bytes(data)
    source = open_frame_source(tmp_path / "edit.mp4")
    assert len(list(read_frames(source, select_all, 99))) == source.n_frames == 10
    assert take_warnings() == []


@pytest.mark.parametrize("name", ["a.mp4", "a.MOV"])
def test_a_file_without_its_index_is_incomplete(tmp_path, name):
    write_steps(tmp_path / "whole.mp4")
    data = (tmp_path / "whole.mp4").read_bytes()
    (tmp_path / name).write_bytes(data[: data.index(b"moov") - 4])
    with pytest.raises(UserError, match=r"cannot be read as a video .*: it is incomplete or no video; copy it"):
        open_frame_source(tmp_path / name)


def test_a_cover_picture_is_not_the_video(tmp_path):
    """A still of another size, marked as a cover, in the track before that of the recording."""
    write_video(tmp_path / "a.mp4", [ramp(90)] * 5)
    path = tmp_path / "b.mkv"
    with av.open(str(tmp_path / "a.mp4")) as recording, av.open(str(path), "w") as container:
        cover = container.add_stream("mjpeg", rate=1)
        cover.width, cover.height, cover.pix_fmt = 32, 32, "yuvj420p"
        copied = container.add_stream_from_template(recording.streams.video[0])
        container.mux(cover.encode(av.VideoFrame.from_ndarray(ramp(9, 32, 32), format="rgb24")))
        container.mux(cover.encode(None))
        for packet in recording.demux(video=0):
            if packet.size:
                packet.stream = copied
                container.mux(packet)
    with av.open(str(path)) as container:
        assert container.streams.video[0].width == 32
    source = open_frame_source(path)
    assert source.n_frames == 5
    assert [frame.rgb.shape for frame in read_frames(source, select_all, 99)] == [(48, 64, 3)] * 5


def test_images_beside_a_video_are_refused(tmp_path):
    write_rgb(tmp_path / "a.png", ramp(9))
    (tmp_path / "._clip.mp4").touch()
    assert open_frame_source(tmp_path).n_frames == 1
    write_video(tmp_path / "clip.mp4", [ramp(9)] * 3)
    with pytest.raises(UserError, match=r"holds images \(a.png\) and a video \(clip.mp4\); move one of them away"):
        open_frame_source(tmp_path)


def test_digits_that_are_no_numbers_are_letters():
    names = [Path(name) for name in ("m10", "m²", "m2", "²")]
    assert [path.name for path in sorted(names, key=natural_sort_key)] == ["m2", "m10", "m²", "²"]
