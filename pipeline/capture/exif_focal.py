"""Focal length from metadata: EXIF of JPEG and TIFF images, QuickTime metadata of videos.

Both store the 35 mm equivalent. According to EXIF 2.3 (tag 0xA405) images of equal diagonals are compared.
"""

import struct
from collections.abc import Iterator
from pathlib import Path

import av

from pipeline.capture.video import FrameSource

FULL_FRAME_DIAGONAL_MM = 43.27
_QUICKTIME_KEY = "com.apple.quicktime.camera.focal_length.35mm_equivalent"
_EXIF_IFD_TAG, _FOCAL_35MM_TAG = 0x8769, 0xA405
_HEADER_BYTES = 1 << 18
_SHORT, _LONG = 3, 4
_ENTRY_BYTES = 12


def metadata_focal_px(source: FrameSource, width_px: int, height_px: int) -> float | None:
    """Return the focal length from the recording's metadata in pixels of images of this size; None if there is none.

    Video stabilisation often crops the sensor after the value was stored, so it is accurate to about a tenth.
    """
    focal_35mm_mm = _exif_focal_35mm_mm(source.files[0]) if source.files else _quicktime_focal_35mm_mm(source.path)
    if focal_35mm_mm is None or focal_35mm_mm <= 0.0:
        return None
    return focal_35mm_mm * float(width_px**2 + height_px**2) ** 0.5 / FULL_FRAME_DIAGONAL_MM


def _quicktime_focal_35mm_mm(path: Path) -> float | None:
    with av.open(str(path)) as container:
        for metadata in (container.metadata, *(stream.metadata for stream in container.streams)):
            try:
                return float(metadata[_QUICKTIME_KEY])
            except (KeyError, ValueError):
                continue
    return None


def _exif_focal_35mm_mm(path: Path) -> float | None:
    """Return millimetres; None also for damaged metadata, which is no reason to refuse an image."""
    with path.open("rb") as file:
        tiff = _tiff_block(file.read(_HEADER_BYTES))
    try:
        byte_order = {b"II": "<", b"MM": ">"}[tiff[:2]]
        first = struct.unpack_from(byte_order + "I", tiff, 4)[0]
        exif = dict(_ifd_entries(tiff, byte_order, first)).get(_EXIF_IFD_TAG, first)
        found = dict(_ifd_entries(tiff, byte_order, exif)).get(_FOCAL_35MM_TAG)
    except (KeyError, struct.error):
        return None
    return None if found is None else float(found)


def _tiff_block(header: bytes) -> bytes:
    """Return the TIFF structure of a file: all of a TIFF file, or the APP1 segment of a JPEG; else empty."""
    if not header.startswith(b"\xff\xd8"):
        return header
    offset = 2
    while offset + 4 <= len(header) and header[offset] == 0xFF and header[offset + 1] != 0xDA:
        length = int.from_bytes(header[offset + 2 : offset + 4], "big")
        if header[offset + 1] == 0xE1 and header[offset + 4 : offset + 10] == b"Exif\0\0":
            return header[offset + 10 : offset + 2 + length]
        offset += 2 + length
    return b""


def _ifd_entries(tiff: bytes, byte_order: str, offset: int) -> Iterator[tuple[int, int]]:
    """Yield (tag, value) of the directory entries that hold one integer."""
    (count,) = struct.unpack_from(byte_order + "H", tiff, offset)
    for start in range(offset + 2, offset + 2 + _ENTRY_BYTES * count, _ENTRY_BYTES):
        tag, kind, size = struct.unpack_from(byte_order + "HHI", tiff, start)
        if size == 1 and kind in (_SHORT, _LONG):
            yield tag, struct.unpack_from(byte_order + ("H" if kind == _SHORT else "I"), tiff, start + 8)[0]
