"""Focal lengths out of metadata: files with known bytes, written by hand and by PyAV."""

import struct
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from PIL import Image

from pipeline.capture.exif_focal import metadata_focal_px
from pipeline.capture.video import open_frame_source


def tiff(order: str, focal_mm: int) -> bytes:
    """A TIFF structure whose EXIF directory holds the focal length for 35 mm film among other entries."""
    mark = b"II" if order == "<" else b"MM"
    start = mark + struct.pack(order + "HI", 42, 8)
    main = struct.pack(order + "H", 2)
    main += struct.pack(order + "HHIHH", 0x0112, 3, 1, 1, 0) + struct.pack(order + "HHII", 0x8769, 4, 1, 38)
    exif = struct.pack(order + "HHHII", 2, 0x829A, 5, 1, 0)
    return start + main + struct.pack(order + "I", 0) + exif + struct.pack(order + "HHIHH", 0xA405, 3, 1, focal_mm, 0)


def with_exif(jpeg: bytes, exif: bytes) -> bytes:
    """A JPEG file with this TIFF structure as its APP1 segment."""
    body = b"Exif\0\0" + exif
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + jpeg[2:]


def write_folder(folder: Path, exif: bytes) -> Path:
    """Two pictures of 300 x 400 pixels, the first with metadata."""
    folder.mkdir()
    jpeg = cv2.imencode(".jpg", np.full((400, 300, 3), 90, dtype=np.uint8))[1].tobytes()
    (folder / "0.jpg").write_bytes(with_exif(jpeg, exif))
    (folder / "1.jpg").write_bytes(jpeg)
    return folder


@pytest.mark.parametrize("order", ["<", ">"])
def test_exif_of_images(tmp_path: Path, order: str) -> None:
    """26 mm on 43.27 mm of film, on a diagonal of 500 pixels."""
    source = open_frame_source(write_folder(tmp_path / "images", tiff(order, 26)))
    assert metadata_focal_px(source, 300, 400) == pytest.approx(26 / 43.27 * 500)
    assert metadata_focal_px(source, 150, 200) == pytest.approx(26 / 43.27 * 250)


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp"])
def test_exif_that_pillow_writes(tmp_path: Path, suffix: str) -> None:
    exif = Image.Exif()
    exif[0x0112] = 1
    exif.get_ifd(0x8769)[0xA405] = 26
    Image.new("RGB", (30, 40)).save(tmp_path / f"0{suffix}", exif=exif)
    assert metadata_focal_px(open_frame_source(tmp_path), 300, 400) == pytest.approx(26 / 43.27 * 500)


@pytest.mark.parametrize("exif", [b"", b"II", tiff("<", 26)[:40], tiff("<", 0), b"nonsense" * 9])
def test_damaged_or_empty_metadata_gives_none(tmp_path: Path, exif: bytes) -> None:
    assert metadata_focal_px(open_frame_source(write_folder(tmp_path / "images", exif)), 300, 400) is None


def test_files_that_are_not_images_give_none(tmp_path: Path) -> None:
    (tmp_path / "0.jpg").write_bytes(b"nonsense" * 9)
    assert metadata_focal_px(open_frame_source(tmp_path), 300, 400) is None


def test_images_without_metadata_give_none(tmp_path: Path) -> None:
    for index in range(2):
        cv2.imwrite(str(tmp_path / f"{index}.png"), np.zeros((40, 30, 3), dtype=np.uint8))
    assert metadata_focal_px(open_frame_source(tmp_path), 30, 40) is None


@pytest.mark.parametrize(("focal_text", "expected"), [("26", 26 / 43.27 * 500), ("much", None), (None, None)])
def test_quicktime_metadata_of_a_video(tmp_path: Path, focal_text: str | None, expected: float | None) -> None:
    path = tmp_path / "phone.mov"
    with av.open(str(path), "w", options={"movflags": "use_metadata_tags"}) as container:
        if focal_text is not None:
            container.metadata["com.apple.quicktime.camera.focal_length.35mm_equivalent"] = focal_text
        stream = container.add_stream("mpeg4", rate=10)
        stream.width, stream.height = 64, 48
        for _ in range(3):
            picture = av.VideoFrame.from_ndarray(np.zeros((48, 64, 3), dtype=np.uint8), format="rgb24")
            container.mux(stream.encode(picture))
        container.mux(stream.encode())
    found = metadata_focal_px(open_frame_source(path), 300, 400)
    assert found == (None if expected is None else pytest.approx(expected))
