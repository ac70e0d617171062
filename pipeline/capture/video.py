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

import av
import cv2
import numpy as np
from av.container import InputContainer
from av.video.stream import VideoStream
from jaxtyping import Int, Shaped, UInt8

from pipeline.capture.video_picture import DecodedImage, read_display_matrix, to_upright_rgb
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

_QUICKTIME_SUFFIXES = (".mp4", ".mov", ".m4v", ".3gp")
_MIN_BOX_BYTES = 8
_HEIF_SUFFIXES = (".heic", ".heif", ".avif")
_IMAGE_FOLDER_NAMES = ("images", "frames", "image", "rgb", "color")
_SWS_AREA = 0x20


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
        UserError: there is no recording, images and a video, or a file that cannot be read as a video.
    """
    if path.is_file():
        return _open_video(path)
    if not path.is_dir():
        raise UserError(f"{path} does not exist; supply a video file or a folder of images")
    files = images_in(path)
    videos = sorted(p for p in path.iterdir() if p.suffix.lower() in VIDEO_SUFFIXES and not p.name.startswith("."))
    if files and len(videos) == 1:
        raise UserError(f"{path} holds images ({files[0].name}) and a video ({videos[0].name}); move one of them away")
    if files:
        return FrameSource(path, files, len(files), image_fps)
    if len(videos) == 1:
        return _open_video(videos[0])
    if videos:
        raise UserError(f"{path} holds {len(videos)} videos; choose one of them, for example {videos[0]}")
    for folder in (path / name for name in _IMAGE_FOLDER_NAMES):
        if folder.is_dir() and images_in(folder):
            files = images_in(folder)
            return FrameSource(folder, files, len(files), image_fps)
    if not any(path.iterdir()):
        raise UserError(f"folder {path} is empty; put a video or images of the person into it")
    if any(file.suffix.lower() in _HEIF_SUFFIXES for file in path.iterdir()):
        raise UserError(f"folder {path} holds HEIC images, which are not read; save them as JPEG, or film a video")
    raise UserError(f"folder {path} holds neither a video nor images; put one of them into it")


def read_frames(source: FrameSource, is_wanted: Callable[[int], bool], max_side_px: int) -> Iterator[Frame]:
    """Yield the wanted frames in order, reduced to at most `max_side_px` on the longer side.

    A video that is truncated or damaged is read as far as possible, with a warning.

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

    def shrink(picture: av.VideoFrame, _: Fraction | None) -> DecodedImage:
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
    first = next(read_frames(source, lambda _: True, max_side_px=1 << 30), None)
    if first is None:
        raise UserError(f"{source.path} has no readable image; use another recording")
    return first.rgb.shape[1], first.rgb.shape[0]


def natural_sort_key(path: Path) -> list[tuple[int, str]]:
    """Return a sort key that orders `frame2` before `frame10`."""
    parts = (part for part in re.split(r"(\d+)", path.name.lower()) if part)
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]


def images_in(folder: Path) -> tuple[Path, ...]:
    """Return the images of a folder in natural order, without hidden ones (`._*`, which macOS adds)."""
    found = (p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith("."))
    return tuple(sorted(found, key=natural_sort_key))


def _open_video(path: Path) -> FrameSource:
    try:
        with open_container(path) as container:
            stream = _best_video_stream(container)
            if stream is None:
                raise UserError(f"{path} has no video track; supply a video file or a folder of images")
            if stream.codec_context is None:
                raise UserError(f"{path} has a video track of an unknown codec; supply an .mp4, .mov or .webm file")
            if stream.width * stream.height > MAX_FRAME_PIXELS:
                raise UserError(
                    f"{path} claims frames of {stream.width}x{stream.height}, at most {MAX_FRAME_PIXELS >> 20} million "
                    "pixels are read; supply a smaller video"
                )
            fps = float(stream.average_rate or stream.guessed_rate or DEFAULT_IMAGE_FPS)
            _warn_if_incomplete(path, stream, container.format.name)
            # Packets hidden by an edit list (a clip that was trimmed without re-encoding) are decoded but not shown.
            n_frames = sum(packet.size > 0 and not packet.is_discard for packet in container.demux(stream))
    except av.FFmpegError as error:
        reason = f"{path} cannot be read as a video ({error.strerror})"
        if path.suffix.lower() in _QUICKTIME_SUFFIXES and path.stat().st_size >= _MIN_BOX_BYTES:
            raise UserError(f"{reason}: it is incomplete or no video; copy it from the camera again") from None
        raise UserError(f"{reason}; supply an .mp4, .mov or .webm file") from None
    return FrameSource(path, (), n_frames, fps)


def _best_video_stream(container: InputContainer) -> VideoStream | None:
    """Return the video track that players choose: no cover picture or preview if there is another one."""
    stream = container.streams.best("video")
    return stream if isinstance(stream, VideoStream) else None


def _warn_if_incomplete(path: Path, stream: VideoStream, format_name: str) -> None:
    """Warn if the index, which other formats than MP4 and QuickTime lack, lists frames behind the end of the file."""
    if "mov" not in format_name.split(","):
        return
    size = path.stat().st_size
    ends = [entry.pos + entry.size for entry in stream.index_entries]
    n_held = sum(end <= size for end in ends)
    if n_held < len(ends):
        warn(f"{path} is incomplete: its index lists {len(ends)} frames, it holds {n_held}; copy it again")


def open_container(path: Path) -> InputContainer:
    """Open a video file; formats that name other files or addresses (playlists, concatenations) are refused.

    Titles and comments that are not UTF-8 do not matter.
    """
    options = {"format_whitelist": ",".join(_FORMATS), "protocol_whitelist": "file"}
    return av.open(str(path), options=options, metadata_errors="replace")


def _images(source: FrameSource, is_wanted: Callable[[int], bool]) -> Iterator[tuple[int, float, DecodedImage]]:
    for index, path in enumerate(source.files):
        if is_wanted(index):
            yield index, index / source.fps, (read_rgb(path), np.asarray)


def _video(
    source: FrameSource,
    is_wanted: Callable[[int], bool],
    convert: Callable[[av.VideoFrame, Fraction | None], DecodedImage] | None = None,
) -> Iterator[tuple[int, float, DecodedImage]]:
    """Yield index, time and converted image (default: `to_upright_rgb`) of the wanted frames."""
    start_s: float | None = None
    time_s: float | None = None
    with open_container(source.path) as container:
        stream = _best_video_stream(container)
        if stream is None:
            return
        stream.thread_type = "AUTO"
        for index, picture in _intact_pictures(source, container, stream):
            time_s = _monotonic_time_s(picture.time, time_s, 1.0 / source.fps)
            start_s = time_s if start_s is None else start_s
            if is_wanted(index):
                convert = convert or partial(to_upright_rgb, display_matrix=read_display_matrix(picture))
                yield index, time_s - start_s, convert(picture, stream.sample_aspect_ratio)


def _intact_pictures(
    source: FrameSource, container: InputContainer, stream: VideoStream
) -> Iterator[tuple[int, av.VideoFrame]]:
    """Yield index and picture of the frames that can be decoded; a damaged packet takes an index as well.

    So later frames keep their index. Threads report damage some frames late, at the same place in every pass.
    """
    index = n_decoded = 0
    is_damaged = False
    packets = container.demux(stream)
    while True:
        try:
            packet = next(packets, None)
        except av.FFmpegError as error:
            warn(f"{source.path} is truncated after {n_decoded} frames ({error.strerror}); these frames are used")
            return
        if packet is None:
            break
        try:
            pictures = packet.decode()
        except av.FFmpegError:
            is_damaged = True
            index += packet.size > 0 and not packet.is_discard
            continue
        for picture in pictures:
            if picture.is_corrupt:
                is_damaged = True
            else:
                n_decoded += 1
                yield index, picture
            index += 1
    if is_damaged:
        n_missing = max(1, source.n_frames - n_decoded)
        warn(
            f"{source.path} is damaged: {n_missing} of {source.n_frames} frames are missing, the others are used; "
            "copy it again"
        )


def _monotonic_time_s(timestamp_s: float | None, previous_s: float | None, step_s: float) -> float:
    """Return the time stamp, or one step after the previous frame if it is missing or not increasing."""
    if previous_s is None:
        return timestamp_s or 0.0
    return timestamp_s if timestamp_s is not None and timestamp_s > previous_s else previous_s + step_s


def downscale(rgb: Shaped[np.ndarray, "h w 3"], max_side_px: int) -> tuple[Shaped[np.ndarray, "h2 w2 3"], float]:
    """Reduce the longer side to at most `max_side_px` by area averaging; return image and factor."""
    scale = min(1.0, max_side_px / max(rgb.shape[:2]))
    if scale == 1.0:
        return rgb, 1.0
    size = (max(1, round(rgb.shape[1] * scale)), max(1, round(rgb.shape[0] * scale)))
    return cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), scale
