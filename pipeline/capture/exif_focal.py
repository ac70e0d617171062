"""Focal length from metadata: EXIF of images, QuickTime metadata of videos.

Both store the 35 mm equivalent. According to EXIF 2.3 (tag 0xA405) images of equal diagonals are compared.
"""

from pathlib import Path

from PIL import ExifTags

from pipeline.capture.video import FrameSource, open_container
from pipeline.io.image import read_exif_tag

FULL_FRAME_DIAGONAL_MM = 43.27
_QUICKTIME_KEY = "com.apple.quicktime.camera.focal_length.35mm_equivalent"


def metadata_focal_px(source: FrameSource, width_px: int, height_px: int) -> float | None:
    """Return the focal length from the recording's metadata in pixels of images of this size; None if there is none.

    Video stabilisation often crops the sensor after the value was stored, so it is accurate to about a tenth.
    """
    focal_35mm_mm = _exif_focal_35mm_mm(source.files[0]) if source.files else _quicktime_focal_35mm_mm(source.path)
    if focal_35mm_mm is None or focal_35mm_mm <= 0.0:
        return None
    return focal_35mm_mm * float(width_px**2 + height_px**2) ** 0.5 / FULL_FRAME_DIAGONAL_MM


def _quicktime_focal_35mm_mm(path: Path) -> float | None:
    with open_container(path) as container:
        for metadata in (container.metadata, *(stream.metadata for stream in container.streams)):
            try:
                return float(metadata[_QUICKTIME_KEY])
            except (KeyError, ValueError):
                continue
    return None


def _exif_focal_35mm_mm(path: Path) -> float | None:
    """Return millimetres; None also for damaged metadata, which is no reason to refuse an image."""
    found = read_exif_tag(path, ExifTags.Base.FocalLengthIn35mmFilm, ExifTags.IFD.Exif)
    return float(found) if isinstance(found, int) else None
