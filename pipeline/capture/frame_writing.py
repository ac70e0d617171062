"""The second pass over a recording: write the selected frames with their masks."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from pipeline.capture.camera_motion import warp_image
from pipeline.capture.capture import IMAGES_FOLDER, MASKS_FOLDER, image_path, mask_path
from pipeline.capture.detection import Detections, decode_mask, read_undistorted_frames, read_user_mask
from pipeline.capture.frame_selection import evenly_spaced
from pipeline.capture.masks.background_plate import BackgroundPlate, estimate_background_plate
from pipeline.capture.masks.matting import (
    decontaminate_colours,
    definite_background,
    estimate_alpha_matte,
    extend_mask_on_uniform_background,
    smooth_mask_temporally,
)
from pipeline.capture.user_files import UserFiles
from pipeline.capture.video import Frame, FrameSource
from pipeline.capture.worker_pool import WorkerPool
from pipeline.core.progress import track
from pipeline.io.image import to_uint8, write_gray, write_rgb

# Maximum number of images of the background estimate; all are in memory at once.
_MAX_PLATE_FRAMES = 32


def write_frames(
    source: FrameSource,
    user_files: UserFiles,
    detections: Detections,
    positions: Sequence[int],
    out: Path,
    max_side_px: int,
    noise: float,
    workers: WorkerPool,
) -> None:
    """Write image and mask of the detections at `positions` into `out`.

    Both are stabilised where the detections are. User-supplied masks are otherwise unchanged; masks of the detector
    are smoothed over neighbouring frames and refined to alpha mattes. Pixels with partial alpha get the estimated
    foreground colour; those of images with their own alpha only as far as they lack it.
    """
    plate = (
        None if user_files.read_mask is not None else estimate_background(source, user_files, detections, max_side_px)
    )
    for folder in (IMAGES_FOLDER, MASKS_FOLDER):
        (out / folder).mkdir(exist_ok=True)
    wanted = set(positions)
    needed = {int(detections.frame_index[p]) for k in wanted for p in _temporal_neighbours(k, detections)}
    frames = read_stabilised_frames(source, user_files, detections, needed.__contains__, max_side_px)

    def tasks() -> Iterator[tuple[object, ...]]:
        for position, near in _temporal_windows(frames, detections, wanted):
            images = np.stack([frame.rgb for frame in near])
            centre = [frame.index for frame in near].index(int(detections.frame_index[position]))
            if user_files.read_mask is not None:
                mask = read_user_mask(user_files, near[centre])
                if mask is not None and detections.to_stabilised is not None:
                    mask = warp_image(mask, detections.to_stabilised[position], is_mask=True)
                yield images[centre], mask, out, near[centre].index, user_files.masks_are_own_alpha
            else:
                masks = [detections.masks_png[p] for p in _temporal_neighbours(position, detections)]
                yield images, masks, out, near[centre].index, centre, noise, plate

    function = _write_frame if user_files.read_mask is not None else _write_matted_frame
    for _ in track(workers.map(function, tasks()), "refining masks", total=len(wanted)):
        pass


def estimate_background(
    source: FrameSource, user_files: UserFiles, detections: Detections, max_side_px: int
) -> BackgroundPlate:
    """Return the background plate from evenly spaced images; masks must come from the detector."""
    found = np.flatnonzero(detections.found)
    sampled = found[evenly_spaced(len(found), _MAX_PLATE_FRAMES)]
    is_taken = set(detections.frame_index[sampled].tolist()).__contains__
    size_px = detections.height, detections.width
    images = np.empty((len(sampled), *size_px, 3), np.uint8)
    frames = read_stabilised_frames(source, user_files, detections, is_taken, max_side_px)
    for image, frame in zip(images, frames, strict=True):
        image[:] = frame.rgb
    masks = [~definite_background(_mask_of_size(detections.masks_png[p], size_px)) for p in sampled]
    return estimate_background_plate(images, np.stack(masks))


def read_stabilised_frames(
    source: FrameSource,
    user_files: UserFiles,
    detections: Detections,
    is_wanted: Callable[[int], bool],
    max_side_px: int,
) -> Iterator[Frame]:
    """Yield frames of the detections, stabilised where they are, without lens distortion."""
    frames = read_undistorted_frames(source, user_files, is_wanted, max_side_px)
    if detections.to_stabilised is None:
        yield from frames
        return
    homography_of = dict(zip(detections.frame_index.tolist(), detections.to_stabilised, strict=True))
    for frame in frames:
        yield replace(frame, rgb=warp_image(frame.rgb, homography_of[frame.index]))


def _temporal_neighbours(position: int, detections: Detections) -> list[int]:
    """Return the position and its neighbours in time in which a person was found."""
    neighbours = range(max(0, position - 1), min(len(detections.found), position + 2))
    return [p for p in neighbours if p == position or detections.found[p]]


def _temporal_windows(
    frames: Iterable[Frame], detections: Detections, wanted: set[int]
) -> Iterator[tuple[int, list[Frame]]]:
    """Yield each wanted position in order with its frame and the frames of its neighbours, as soon as they are read."""
    buffered: dict[int, Frame] = {}
    pending = sorted(wanted)
    for frame in frames:
        buffered[frame.index] = frame
        while pending:
            near = [int(detections.frame_index[p]) for p in _temporal_neighbours(pending[0], detections)]
            if frame.index < near[-1]:
                break
            yield pending.pop(0), [buffered[index] for index in near]
            buffered = {index: kept for index, kept in buffered.items() if index >= near[0]}


def _write_frame(
    rgb: UInt8[np.ndarray, "h w 3"],
    mask: UInt8[np.ndarray, "h w"],
    out: Path,
    frame_index: int,
    is_own_alpha: bool = False,
) -> None:
    write_rgb(image_path(out, frame_index), decontaminate_colours(rgb, mask, is_own_alpha=is_own_alpha))
    write_gray(mask_path(out, frame_index), mask)


def _write_matted_frame(
    images: UInt8[np.ndarray, "t h w 3"],
    masks_png: Sequence[bytes],
    out: Path,
    frame_index: int,
    centre: int,
    noise: float,
    plate: BackgroundPlate,
) -> None:
    """Compute and write the matte of one frame (runs in a worker thread)."""
    height, width = images.shape[1:3]
    masks = np.stack([_mask_of_size(data, (height, width)) for data in masks_png])
    mask = extend_mask_on_uniform_background(images[centre], smooth_mask_temporally(images, masks, centre, noise))
    alpha = estimate_alpha_matte(images[centre], mask, plate)
    _write_frame(images[centre], to_uint8(alpha), out, frame_index)


def _mask_of_size(mask_png: bytes, size_px: tuple[int, int]) -> UInt8[np.ndarray, "h w"]:
    """Return a mask of the detector at the size (height, width) of the images."""
    mask = decode_mask(mask_png)
    return mask if mask.shape == size_px else cv2.resize(mask, size_px[::-1], interpolation=cv2.INTER_LINEAR)
