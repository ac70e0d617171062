"""Frames of a video file or an image folder as upright RGB images with square pixels.

Rotation, pixel aspect ratio, colour space and time stamps of the container, and EXIF of images, are applied. A frame
keeps its index in the recording, whichever frames are read.
"""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import cast

import av
import cv2
import numpy as np
from av.container import InputContainer
from av.video.stream import VideoStream
from jaxtyping import Int, Shaped, UInt8

from pipeline.capture import hdr
from pipeline.core.errors import UserError
from pipeline.core.progress import warn
from pipeline.io.image import IMAGE_SUFFIXES, read_rgb

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".mts", ".3gp", ".wmv", ".gif")
DEFAULT_IMAGE_FPS = 30.0
MAX_FRAME_PIXELS = 1 << 27
"""Pixels of a frame: four times those of 8K video. A damaged or malicious header may claim any size."""

_FORMATS = (
    *("mov", "mp4", "m4a", "3gp", "3g2", "mj2", "avi", "matroska", "webm", "mpeg", "mpegts", "mpegvideo", "asf", "gif"),
    *("mjpeg", "flv", "ogg", "h264", "hevc", "wav", "mp3", "aac", "flac"),
)
"""FFmpeg's names of formats whose files hold all of their content; those of sound get a message of their own."""

_HEIF_SUFFIXES = (".heic", ".heif", ".avif")
_IMAGE_FOLDER_NAMES = ("images", "frames", "image", "rgb", "color")
# Bicubic, with chroma brought to full resolution before the colour matrix: swscale's default repeats each chroma
# sample over 2 x 2 pixels, which leaves visible blocks along the person's outline (bits of libswscale's SWS_* flags).
_SWS_FLAGS = 0x4 | 0x2000 | 0x4000 | 0x40000
_SWS_AREA = 0x20
_UNSPECIFIED, _BT_709 = 2, 1
"""Codes of matrix coefficients (ITU-T H.273, table 4)."""
# A decoded image (8-bit sRGB, or 16 bits with another transfer function) and its conversion to 8-bit sRGB.
_DecodedImage = tuple[np.ndarray, Callable[[np.ndarray], np.ndarray]]


@dataclass(frozen=True)
class FrameSource:
    """A recording: a video file (then `files` is empty), or images in natural order."""

    path: Path
    files: tuple[Path, ...]
    n_frames: int
    fps: float


@dataclass(frozen=True)
class Frame:
    """One image of the recording; `scale` is its size relative to the original (at most 1)."""

    index: int
    time_s: float
    rgb: UInt8[np.ndarray, "h w 3"]
    scale: float


def open_frame_source(path: Path, image_fps: float = DEFAULT_IMAGE_FPS) -> FrameSource:
    """Open a video file or a folder.

    A folder may hold images, one video file, or a folder `images`/`frames` with images. Images have no frame rate:
    `image_fps` is used.

    Raises:
        UserError: there is no recording, or the file cannot be read as a video.
    """
    if path.is_file():
        return _open_video(path)
    if not path.is_dir():
        raise UserError(f"{path} does not exist; supply a video file or a folder of images")
    files = _images_in(path)
    videos = sorted(p for p in path.iterdir() if p.suffix.lower() in VIDEO_SUFFIXES)
    if files:
        return FrameSource(path, files, len(files), image_fps)
    if len(videos) == 1:
        return _open_video(videos[0])
    if videos:
        raise UserError(f"{path} holds {len(videos)} videos; choose one of them, for example {videos[0]}")
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
    """Yield the wanted frames in order, reduced to at most `max_side_px` on the longer side.

    A video that is truncated is read as far as possible, with a warning.

    Raises:
        UserError: an image cannot be read, or the image size changes.
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
        downscaled, scale = downscale(rgb, max_side_px)
        yield Frame(index, time_s, to_srgb(downscaled), scale)


def read_thumbnails(
    source: FrameSource, is_wanted: Callable[[int], bool], side_px: int
) -> tuple[Int[np.ndarray, "n"], UInt8[np.ndarray, "n h w"]]:
    """Return the indices of the wanted frames and small grey images of them, to compare frames with each other.

    They are not upright, and their grey is that of the file. side_px: largest longer side.

    Raises:
        UserError: no frame can be read, or their shape changes.
    """

    def shrink(picture: av.VideoFrame, _: Fraction | None) -> _DecodedImage:
        scale = min(1.0, side_px / max(picture.width, picture.height))
        width, height = (max(1, round(scale * side)) for side in (picture.width, picture.height))
        small = picture.reformat(width, height, format="gray", interpolation=_SWS_AREA)
        return small.to_ndarray(), np.asarray

    if source.files:
        frames = read_frames(source, is_wanted, side_px)
        found = [(frame.index, cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)) for frame in frames]
    else:
        found = [(index, gray) for index, _, (gray, _) in _video(source, is_wanted, shrink)]
    if not found:
        raise UserError(f"{source.path} has no readable frame; use another video")
    odd = next((index for index, gray in found if gray.shape != found[0][1].shape), None)
    if odd is not None:
        raise UserError(f"frame {odd} of {source.path} has another shape than those before; cut the video there")
    return np.array([index for index, _ in found], dtype=np.int32), np.stack([gray for _, gray in found])


def image_size_px(source: FrameSource) -> tuple[int, int]:
    """Return width and height of the first image, upright and with square pixels.

    Raises:
        UserError: no image can be read.
    """
    first = next(read_frames(source, lambda index: index == 0, max_side_px=1 << 30), None)
    if first is None:
        raise UserError(f"{source.path} has no readable image; use another recording")
    return first.rgb.shape[1], first.rgb.shape[0]


def natural_sort_key(path: Path) -> list[tuple[int, str]]:
    """Return a sort key that orders `frame2` before `frame10`."""
    return [
        (int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", path.name.lower()) if part
    ]


def _images_in(folder: Path) -> tuple[Path, ...]:
    found = (p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith("."))
    return tuple(sorted(found, key=natural_sort_key))


def _open_video(path: Path) -> FrameSource:
    try:
        with open_container(path) as container:
            stream = _video_stream(container, path)
            if stream.codec_context is None:
                raise UserError(f"{path} has a video track of an unknown codec; supply an .mp4, .mov or .webm file")
            if stream.width * stream.height > MAX_FRAME_PIXELS:
                raise UserError(
                    f"{path} claims frames of {stream.width}x{stream.height}, at most {MAX_FRAME_PIXELS >> 20} million "
                    "pixels are read; supply a smaller video"
                )
            fps = float(stream.average_rate or stream.guessed_rate or DEFAULT_IMAGE_FPS)
            # Packets hidden by an edit list (a clip that was trimmed without re-encoding) are decoded but not shown.
            is_shown = [not packet.is_discard for packet in container.demux(stream) if packet.size > 0]
            if "mov" in container.format.name and stream.frames > len(is_shown):
                warn(f"{path} is incomplete: {len(is_shown)} of its {stream.frames} frames are there; copy it again")
    except av.FFmpegError as error:
        raise UserError(
            f"{path} cannot be read as a video ({error.strerror}); supply an .mp4, .mov or .webm file"
        ) from None
    return FrameSource(path, (), sum(is_shown), fps)


def _video_stream(container: InputContainer, path: Path) -> VideoStream:
    stream = container.streams.best("video")
    if not isinstance(stream, VideoStream):
        raise UserError(f"{path} has no video track; supply a video file or a folder of images")
    return stream


def open_container(path: Path) -> InputContainer:
    """Open a video file; formats that name other files or addresses (playlists, concatenations) are refused.

    Titles and comments that are not UTF-8 do not matter.
    """
    options = {"format_whitelist": ",".join(_FORMATS), "protocol_whitelist": "file"}
    return av.open(str(path), options=options, metadata_errors="replace")


def _images(source: FrameSource, is_wanted: Callable[[int], bool]) -> Iterator[tuple[int, float, _DecodedImage]]:
    for index, path in enumerate(source.files):
        if is_wanted(index):
            yield index, index / source.fps, (read_rgb(path), np.asarray)


def _video(
    source: FrameSource,
    is_wanted: Callable[[int], bool],
    convert: Callable[[av.VideoFrame, Fraction | None], _DecodedImage] | None = None,
) -> Iterator[tuple[int, float, _DecodedImage]]:
    """Yield index, time and converted image (default: `_to_upright_rgb`) of the wanted frames."""
    convert = convert or _to_upright_rgb
    start_s: float | None = None
    time_s: float | None = None
    index = -1
    with open_container(source.path) as container:
        stream = _video_stream(container, source.path)
        stream.thread_type = "AUTO"
        try:
            for index, picture in enumerate(_decode(container, stream, source.path)):
                time_s = _monotonic_time_s(picture.time, time_s, 1.0 / source.fps)
                start_s = time_s if start_s is None else start_s
                if is_wanted(index):
                    yield index, time_s - start_s, convert(picture, stream.sample_aspect_ratio)
        except av.FFmpegError as error:
            warn(f"{source.path} is truncated after {index + 1} frames ({error.strerror}); these frames are used")


def _decode(container: InputContainer, stream: VideoStream, path: Path) -> Iterator[av.VideoFrame]:
    """Yield the decoded frames; damaged packets, and frames that lack them, are left out with a warning."""
    damaged = 0
    for packet in container.demux(stream):
        try:
            pictures = packet.decode()
        except av.InvalidDataError:
            damaged += 1
            continue
        whole = [picture for picture in pictures if not (damaged and picture.is_corrupt)]
        damaged += len(pictures) - len(whole)
        yield from whole
    if damaged:
        warn(f"{path} is damaged: about {damaged} frames are left out; copy it again if you have another copy")


def _monotonic_time_s(timestamp_s: float | None, previous_s: float | None, step_s: float) -> float:
    """Return the time stamp, or one step after the previous frame if it is missing or not increasing."""
    if previous_s is None:
        return timestamp_s or 0.0
    return timestamp_s if timestamp_s is not None and timestamp_s > previous_s else previous_s + step_s


def _to_upright_rgb(picture: av.VideoFrame, aspect: Fraction | None) -> _DecodedImage:
    """Return the RGB image of a decoded frame with square pixels, turned as the container says."""
    transfer, primaries = int(picture.color_trc), int(picture.color_primaries)
    is_hdr = transfer in hdr.HDR_TRANSFERS
    pixels = picture.reformat(
        format="rgb48le" if is_hdr else "rgb24", src_colorspace=_assumed_matrix(picture), interpolation=_SWS_FLAGS
    )
    rgb: np.ndarray = pixels.to_ndarray()
    if picture.interlaced_frame:
        rgb = _first_field(rgb)
    if aspect and aspect != 1:
        rgb = cv2.resize(rgb, (round(rgb.shape[1] * aspect), rgb.shape[0]), interpolation=cv2.INTER_CUBIC)
    to_srgb = partial(hdr.to_srgb, transfer=transfer, primaries=primaries) if is_hdr else np.asarray
    return _upright(rgb, picture), to_srgb


def _assumed_matrix(picture: av.VideoFrame) -> int | None:
    """Return the code of the colour matrix of a frame that names none: BT.709 for high definition, as players assume.

    None: the frame names one, or is of standard definition (BT.601), or of JPEG's full range (always BT.601).
    """
    is_untagged = picture.colorspace == _UNSPECIFIED and picture.format.name.startswith("yuv")
    is_high_definition = picture.width >= 1280 or picture.height > 576
    if is_untagged and is_high_definition and not picture.format.name.startswith("yuvj"):
        return _BT_709
    return None


def _first_field(rgb: Shaped[np.ndarray, "h w 3"]) -> Shaped[np.ndarray, "h w 3"]:
    """Return an interlaced image with the second field interpolated from the first: they are of different times."""
    single = rgb.copy()
    below = rgb[2::2].astype(np.float32)
    between = single[1::2][: len(below)]
    between[:] = np.rint(0.5 * (rgb[0::2][: len(below)] + below))
    return single


def _upright(rgb: Shaped[np.ndarray, "h w 3"], picture: av.VideoFrame) -> Shaped[np.ndarray, "h2 w2 3"]:
    """Return the image turned by quarters and mirrored as the container's display matrix says.

    The matrix (a b; c d) sends a pixel to x' = a x + c y, y' = b x + d y (ISO 14496-12, track header).
    """
    stored = picture.side_data.get("DISPLAYMATRIX")
    if stored is None:
        return np.ascontiguousarray(rgb)
    (a, b, _), (c, d, _), _ = np.frombuffer(cast(bytes, stored), np.int32).reshape(3, 3).tolist()
    if abs(a) < abs(b):
        rgb, a, d = rgb.swapaxes(0, 1), c, b
    return np.ascontiguousarray(rgb[:: -1 if d < 0 else 1, :: -1 if a < 0 else 1])


def downscale(rgb: Shaped[np.ndarray, "h w 3"], max_side_px: int) -> tuple[Shaped[np.ndarray, "h2 w2 3"], float]:
    """Reduce the longer side to at most `max_side_px` by area averaging; return image and factor."""
    scale = min(1.0, max_side_px / max(rgb.shape[:2]))
    if scale == 1.0:
        return rgb, 1.0
    size = (max(1, round(rgb.shape[1] * scale)), max(1, round(rgb.shape[0] * scale)))
    return cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), scale
