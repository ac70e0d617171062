"""Frames of a video file or of a folder of images, upright, with square pixels, in RGB.

What the container says about rotation, pixel aspect, colours and times is honoured, and what EXIF says for images.
A frame keeps its index in the whole recording, however few frames are read.
"""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from pathlib import Path

import av
import cv2
import numpy as np
from jaxtyping import Shaped, UInt8

from pipeline.capture import hdr
from pipeline.core.errors import UserError
from pipeline.core.progress import warn
from pipeline.io.image import IMAGE_SUFFIXES, read_rgb

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".mts", ".3gp", ".wmv", ".gif")
DEFAULT_IMAGE_FPS = 30.0
_HEIF_SUFFIXES = (".heic", ".heif", ".avif")
_IMAGE_FOLDER_NAMES = ("images", "frames", "image", "rgb", "color")
# Bicubic, with chroma brought to full resolution before the colour matrix: swscale's default repeats each chroma
# sample over 2 x 2 pixels, which leaves visible blocks along the person's outline (bits of libswscale's SWS_* flags).
_SWS_FLAGS = 0x4 | 0x2000 | 0x4000 | 0x40000
# A picture as it comes, 8 bits of sRGB or 16 bits of another curve, and how the first is made of it.
_DecodedImage = tuple[np.ndarray, Callable[[np.ndarray], np.ndarray]]


@dataclass(frozen=True)
class FrameSource:
    """A recording: a video file (then `files` is empty), or images in their natural order."""

    path: Path
    files: tuple[Path, ...]
    n_frames: int
    fps: float


@dataclass(frozen=True)
class Frame:
    """One picture of the recording; `scale` is its size relative to the original one (1 or smaller)."""

    index: int
    time_s: float
    rgb: UInt8[np.ndarray, "h w 3"]
    scale: float


def open_frame_source(path: Path, image_fps: float = DEFAULT_IMAGE_FPS) -> FrameSource:
    """Look at a file or folder and say what recording it holds.

    A folder may hold images, one video file, or a folder `images`/`frames` with images. Images do not say how many a
    second there were; `image_fps` does.
    Raises UserError when there is none, or when the file cannot be read as a video.
    """
    if path.is_file():
        return _open_video(path)
    if not path.is_dir():
        raise UserError(f"{path} does not exist; give a video file or a folder of images with VIDEO=")
    files = _images_in(path)
    videos = sorted(p for p in path.iterdir() if p.suffix.lower() in VIDEO_SUFFIXES)
    if files:
        return FrameSource(path, files, len(files), image_fps)
    if len(videos) == 1:
        return _open_video(videos[0])
    if videos:
        raise UserError(f"{path} holds {len(videos)} videos; give one of them, for example VIDEO={videos[0]}")
    for folder in (path / name for name in _IMAGE_FOLDER_NAMES):
        if folder.is_dir() and _images_in(folder):
            files = _images_in(folder)
            return FrameSource(folder, files, len(files), image_fps)
    if not any(path.iterdir()):
        raise UserError(f"folder {path} is empty; put a video or images of the person into it")
    if any(file.suffix.lower() in _HEIF_SUFFIXES for file in path.iterdir()):
        raise UserError(f"folder {path} holds HEIC images, which are not read; save them as JPEG, or film a video")
    raise UserError(f"folder {path} holds neither a video nor images; put one of them into it")


def read_frames(source: FrameSource, is_wanted: Callable[[int], bool], max_side_px: int) -> Iterator[Frame]:
    """Yield the wanted frames in order, none larger than `max_side_px` on its longer side.

    Raises UserError for an unreadable image, or images that change their size. A video that breaks off is read as far
    as it goes, with a warning.
    """
    size_px: tuple[int, ...] | None = None
    for index, time_s, (rgb, to_srgb) in _images(source, is_wanted) if source.files else _video(source, is_wanted):
        if size_px is not None and rgb.shape[:2] != size_px:
            name = source.files[index] if source.files else f"frame {index} of {source.path}"
            raise UserError(
                f"{name} is {rgb.shape[1]}x{rgb.shape[0]}, the frames before are {size_px[1]}x{size_px[0]}; "
                "all frames must come from one camera at one size: remove or resize the odd ones"
            )
        size_px = rgb.shape[:2]
        downscaled, scale = _downscale(rgb, max_side_px)
        yield Frame(index, time_s, to_srgb(downscaled), scale)


def image_size_px(source: FrameSource) -> tuple[int, int]:
    """Width and height of the recording's first picture, upright and with square pixels.

    Raises UserError when no picture can be read.
    """
    first = next(read_frames(source, lambda index: index == 0, max_side_px=1 << 30), None)
    if first is None:
        raise UserError(f"{source.path} has no picture that can be read; give another recording")
    return first.rgb.shape[1], first.rgb.shape[0]


def natural_sort_key(path: Path) -> list[tuple[int, str]]:
    """Sort key under which `frame2` comes before `frame10`."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", path.name.lower()) if part]


def _images_in(folder: Path) -> tuple[Path, ...]:
    found = (p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith("."))
    return tuple(sorted(found, key=natural_sort_key))


def _open_video(path: Path) -> FrameSource:
    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise UserError(f"{path} has no picture track; give a video file or a folder of images")
            stream = container.streams.video[0]
            fps = float(stream.average_rate or stream.guessed_rate or DEFAULT_IMAGE_FPS)
            # An edit list (a clip that was cut without encoding it anew) has pictures that are decoded but never shown.
            n_frames = sum(packet.size > 0 and not packet.is_discard for packet in container.demux(stream))
    except av.FFmpegError as error:
        raise UserError(
            f"{path} is no video that can be read ({error.strerror}); give an .mp4, .mov or .webm file"
        ) from None
    return FrameSource(path, (), n_frames, fps)


def _images(source: FrameSource, is_wanted: Callable[[int], bool]) -> Iterator[tuple[int, float, _DecodedImage]]:
    for index, path in enumerate(source.files):
        if is_wanted(index):
            yield index, index / source.fps, (read_rgb(path), np.asarray)


def _video(source: FrameSource, is_wanted: Callable[[int], bool]) -> Iterator[tuple[int, float, _DecodedImage]]:
    start_s: float | None = None
    time_s: float | None = None
    index = -1
    with av.open(str(source.path)) as container:
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        try:
            for index, picture in enumerate(container.decode(stream)):
                time_s = _monotonic_time_s(picture.time, time_s, 1.0 / source.fps)
                start_s = time_s if start_s is None else start_s
                if is_wanted(index):
                    yield index, time_s - start_s, _to_upright_rgb(picture, stream.sample_aspect_ratio)
        except av.FFmpegError as error:
            warn(f"{source.path} breaks off after {index + 1} frames ({error.strerror}); going on with those")


def _monotonic_time_s(timestamp_s: float | None, previous_s: float | None, step_s: float) -> float:
    """A frame's time stamp, or one step after the frame before where it is missing or does not lie after that one."""
    if previous_s is None:
        return timestamp_s or 0.0
    return timestamp_s if timestamp_s is not None and timestamp_s > previous_s else previous_s + step_s


def _to_upright_rgb(picture: av.VideoFrame, aspect: Fraction | None) -> _DecodedImage:
    """Colour pixels of a decoded picture with square pixels, turned as the container asks."""
    transfer, primaries = int(picture.color_trc), int(picture.color_primaries)
    is_hdr = transfer in hdr.HDR_TRANSFERS
    pixels = picture.reformat(format="rgb48le" if is_hdr else "rgb24", interpolation=_SWS_FLAGS)
    rgb: np.ndarray = pixels.to_ndarray()
    if aspect and aspect != 1:
        rgb = cv2.resize(rgb, (round(rgb.shape[1] * aspect), rgb.shape[0]), interpolation=cv2.INTER_CUBIC)
    to_srgb = partial(hdr.to_srgb, transfer=transfer, primaries=primaries) if is_hdr else np.asarray
    return np.ascontiguousarray(np.rot90(rgb, k=round(picture.rotation / 90) % 4)), to_srgb


def _downscale(rgb: Shaped[np.ndarray, "h w 3"], max_side_px: int) -> tuple[Shaped[np.ndarray, "h2 w2 3"], float]:
    """The picture with its longer side at most `max_side_px`, and the factor; area averaging avoids aliasing."""
    scale = min(1.0, max_side_px / max(rgb.shape[:2]))
    if scale == 1.0:
        return rgb, 1.0
    size = (max(1, round(rgb.shape[1] * scale)), max(1, round(rgb.shape[0] * scale)))
    return cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), scale
