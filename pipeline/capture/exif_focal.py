"""The focal length that a camera wrote into its files: EXIF of JPEG and TIFF images, QuickTime metadata of videos.

Both are given as for 35 mm film. After EXIF 2.3 (tag 0xA405) the two pictures have equal diagonals.
"""

import struct
from collections.abc import Iterator
from pathlib import Path

import av

from pipeline.capture.video import Source

FILM_DIAGONAL_MM = 43.27
_QUICKTIME_KEY = "com.apple.quicktime.camera.focal_length.35mm_equivalent"
_EXIF_POINTER, _FOCAL_35MM = 0x8769, 0xA405
_HEAD_BYTES = 1 << 18
_SHORT, _LONG = 3, 4
_ENTRY_BYTES = 12


def recorded_focal_px(source: Source, width_px: int, height_px: int) -> float | None:
    """Focal length in pixels of pictures of this size, by the recording's own metadata; None where it says nothing.

    Videos are often cut out of the sensor after the lens was noted (stabilisation), so it is good to about a tenth.
    """
    film_mm = _film_focal_of_image(source.files[0]) if source.files else _film_focal_of_video(source.path)
    if film_mm is None or film_mm <= 0.0:
        return None
    return film_mm * float(width_px**2 + height_px**2) ** 0.5 / FILM_DIAGONAL_MM


def _film_focal_of_video(path: Path) -> float | None:
    with av.open(str(path)) as container:
        for metadata in (container.metadata, *(stream.metadata for stream in container.streams)):
            try:
                return float(metadata[_QUICKTIME_KEY])
            except (KeyError, ValueError):
                continue
    return None


def _film_focal_of_image(path: Path) -> float | None:
    """Millimetres; None also for damaged metadata, which is no reason to refuse a picture."""
    with path.open("rb") as file:
        tiff = _tiff_part(file.read(_HEAD_BYTES))
    try:
        order = {b"II": "<", b"MM": ">"}[tiff[:2]]
        first = struct.unpack_from(order + "I", tiff, 4)[0]
        exif = dict(_entries(tiff, order, first)).get(_EXIF_POINTER, first)
        found = dict(_entries(tiff, order, exif)).get(_FOCAL_35MM)
    except (KeyError, struct.error):
        return None
    return None if found is None else float(found)


def _tiff_part(head: bytes) -> bytes:
    """The TIFF structure of a file's beginning: the whole of a TIFF file, the APP1 segment of a JPEG; else empty."""
    if not head.startswith(b"\xff\xd8"):
        return head
    place = 2
    while place + 4 <= len(head) and head[place] == 0xFF and head[place + 1] != 0xDA:
        length = int.from_bytes(head[place + 2 : place + 4], "big")
        if head[place + 1] == 0xE1 and head[place + 4 : place + 10] == b"Exif\0\0":
            return head[place + 10 : place + 2 + length]
        place += 2 + length
    return b""


def _entries(tiff: bytes, order: str, place: int) -> Iterator[tuple[int, int]]:
    """(tag, value) of a directory's entries that hold one whole number."""
    (count,) = struct.unpack_from(order + "H", tiff, place)
    for start in range(place + 2, place + 2 + _ENTRY_BYTES * count, _ENTRY_BYTES):
        tag, kind, size = struct.unpack_from(order + "HHI", tiff, start)
        if size == 1 and kind in (_SHORT, _LONG):
            yield tag, struct.unpack_from(order + ("H" if kind == _SHORT else "I"), tiff, start + 8)[0]
