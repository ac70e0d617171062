"""The pixels that training draws from: on the body, along its border, and a few outside."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from pipeline.geometry.camera import Camera
from pipeline.kernels.pixel_sampling import PosedCameras, count_uniforms, sample_pixels, update_error_map

PIXEL_CLASSES = ("body", "border", "outside")
MAX_OUTSIDE_PIXELS_PER_FRAME = 20_000
TILE_PX = 16
ERROR_DECAY = 0.8
"""What is left of a tile's error at each new pixel of it."""


class ErrorMap:
    """Where the learning errs: the mean colour error of late in every tile of every frame."""

    def __init__(self, frames: int, xy_px: Int[np.ndarray, "p 2"]) -> None:
        """All tiles alike. xy_px: every pixel that will ever be asked for."""
        self.xy_px = xy_px
        columns, rows = xy_px.max(axis=0) // TILE_PX + 1
        self.error = np.ones((frames, rows, columns), dtype=np.float32)

    def update(
        self, rows: Int[np.ndarray, "n"], frame: Int[np.ndarray, "n"], colour_error: Float[np.ndarray, "n 3"]
    ) -> None:
        """Take in what pixels of some frames, those of a frame side by side, erred by in colour."""
        update_error_map(rows, frame, self.xy_px, colour_error, ERROR_DECAY, TILE_PX, self.error)


@dataclass(frozen=True)
class PixelPool:
    """Pixels of all training frames, frame by frame and kind by kind.

    xy_px: column and row. rgba: colour and mask, uint8. start: (frames, 4) offsets; the pixels of kind q of frame f are
    start[f, q] : start[f, q + 1].
    """

    xy_px: Int[np.ndarray, "p 2"]
    rgba: UInt8[np.ndarray, "p 4"]
    start: Int[np.ndarray, "frames 4"]

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.start)

    def sample_counts(
        self, frames: Int[np.ndarray, "k"], rays: float, class_ratios: tuple[float, float, float]
    ) -> Int[np.ndarray, "k kinds"]:
        """How many pixels of each kind `sample_pixels` takes of each frame, when a frame has `rays` in all; none of a
        kind that
        a frame is without. shares: parts of the rays on the body, its border and outside.
        """
        target_counts = np.rint(rays * np.array(class_ratios)).astype(np.int64)
        return target_counts * (np.diff(self.start[frames], axis=1) > 0)

    def sample_pixels(
        self,
        frames: Int[np.ndarray, "k"],
        sample_counts: Int[np.ndarray, "k kinds"],
        rngs: Sequence[np.random.Generator],
        error_map: ErrorMap,
        error_ratio: float = 0.0,
        outlier_threshold: float = np.inf,
    ) -> tuple[Int[np.ndarray, "n"], Float[np.ndarray, "n"]]:
        """Rows of random pixels of some frames, so many of each kind, evenly spread over the pixels of their kind; and
        the trust in each, in [0, 1].

        streams: of random numbers, one for each frame, so that its pixels hang on it alone. by_error: part of the rays
        on the body that goes where `error_map` are large. outlier: how large they may be in a frame, in medians, before
        they tell that something else than the person is seen there.
        """
        by_error_counts = np.zeros_like(sample_counts)
        by_error_counts[:, PIXEL_CLASSES.index("body")] = np.rint(
            error_ratio * sample_counts[:, PIXEL_CLASSES.index("body")]
        )
        uniform_counts = count_uniforms(sample_counts, by_error_counts).tolist()
        uniforms = np.concatenate([stream.random(count) for stream, count in zip(rngs, uniform_counts, strict=True)])
        return sample_pixels(
            self.start,
            self.xy_px,
            frames,
            sample_counts,
            by_error_counts,
            error_map.error,
            TILE_PX,
            outlier_threshold,
            uniforms,
        )


def posed_space_cameras(camera: Camera, world_to_posed: Float[np.ndarray, "frames 4 4"]) -> PosedCameras:
    """How the camera sees each frame's posed space."""
    rotation, translation_m = world_to_posed[:, :3, :3], world_to_posed[:, :3, 3]
    intrinsics = np.array([[camera.fx, camera.fy], [camera.cx, camera.cy]], np.float32)
    origin_m, axes = rotation @ camera.centre_m() + translation_m, rotation @ camera.world_to_camera[:3, :3].T
    return PosedCameras(
        intrinsics[0], intrinsics[1], origin_m.astype(np.float32), np.ascontiguousarray(axes, np.float32)
    )


def build_pixel_pool(
    images: Iterable[tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]], border_px: int, seed: int
) -> PixelPool:
    """Sort the pixels of each (image, mask) into the three kinds.

    border_px: half width of the band around the mask's edge. Outside pixels come from the body's box, widened by a
    tenth, and are thinned to a fixed number a frame.
    """
    xy, rgba, starts, total = [], [], [], 0
    for index, (image, mask) in enumerate(images):
        start = [total]
        for row_column in _classify_pixels(mask, border_px, np.random.default_rng((seed, index))):
            rows, columns = row_column
            xy.append(np.stack([columns, rows], axis=-1).astype(np.int16))
            rgba.append(np.concatenate([image[rows, columns], mask[rows, columns, None]], axis=-1))
            total += len(rows)
            start.append(total)
        starts.append(start)
    return PixelPool(np.concatenate(xy), np.concatenate(rgba), np.array(starts, dtype=np.int64))


def _classify_pixels(mask: UInt8[np.ndarray, "h w"], border_px: int, random: np.random.Generator) -> list[tuple]:
    """Rows and columns of the body, border and outside pixels of one mask."""
    solid = (mask >= 128).astype(np.uint8)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * border_px + 1, 2 * border_px + 1))
    outer, inner = cv2.dilate(solid, kernel), cv2.erode(solid, kernel, borderValue=(0,))
    border = (outer > inner) | ((mask > 0) & (mask < 255) & (outer > 0))
    rows, columns = np.nonzero(outer)
    outside = np.zeros(mask.shape, dtype=bool)
    if len(rows):
        pad = 8 + int(0.1 * (np.ptp(rows) + 1))
        outside[max(rows.min() - pad, 0) : rows.max() + pad, max(columns.min() - pad, 0) : columns.max() + pad] = True
    outside &= (outer == 0) & (mask == 0)
    outside_index = np.flatnonzero(outside)
    if len(outside_index) > MAX_OUTSIDE_PIXELS_PER_FRAME:
        outside_index = np.sort(random.choice(outside_index, MAX_OUTSIDE_PIXELS_PER_FRAME, replace=False))
    return [np.nonzero(solid & ~border), np.nonzero(border), np.unravel_index(outside_index, mask.shape)]
