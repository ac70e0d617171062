"""Pool of training pixels in three classes (body, mask border, outside), and sampling from it.

Letters: p pixels of all frames, k frames of a batch, q pixel classes, n sampled pixels.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from pipeline.geometry.camera import Camera
from pipeline.kernels.pixel_sampling import (
    PixelLists,
    PosedCameras,
    SampleCounts,
    TileErrors,
    count_uniforms,
    sample_pixels,
    update_error_map,
)

PIXEL_CLASSES = ("body", "border", "outside")
MAX_OUTSIDE_PIXELS_PER_FRAME = 20_000
TILE_PX = 16
ERROR_DECAY = 0.8
"""Factor of a tile's error at each new pixel of it."""


class ErrorMap:
    """Moving average of the colour error in square tiles of every training frame; the source of importance sampling."""

    def __init__(self, frames: int, xy_px: Int[np.ndarray, "p 2"]) -> None:
        """Start with equal errors. xy_px: column and row of every pixel of the pool."""
        self.xy_px = xy_px
        columns, rows = xy_px.max(axis=0) // TILE_PX + 1
        self.error = np.ones((frames, rows, columns), dtype=np.float32)

    def update(
        self,
        pixel_index: Int[np.ndarray, "n"],
        frame_index: Int[np.ndarray, "n"],
        colour_error: Float[np.ndarray, "n 3"],
    ) -> None:
        """Update the tiles of some pixels, ordered by frame, with their colour errors."""
        update_error_map(pixel_index, frame_index, self.xy_px, colour_error, ERROR_DECAY, TILE_PX, self.error)


@dataclass(frozen=True)
class PixelPool:
    """Pixels of all training frames, ordered by frame and class.

    xy_px: column and row. rgba: colour and mask, uint8. start: offsets; the pixels of class q of frame f are
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
        """Return how many pixels of each class a frame with `rays` rays contributes; 0 for classes it does not have.

        class_ratios: fractions of the rays on the body, on its border and outside.
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
        """Draw pixels of some frames, stratified over each class; return their rows in the pool and inlier weights.

        sample_counts: pixels of each frame and class, from `sample_counts`. rngs: one generator for each frame, so that
        its pixels do not depend on the other frames. error_ratio: fraction of the body pixels that are drawn in
        proportion to `error_map`. outlier_threshold: error, as a multiple of the frame's median, above which the inlier
        weight falls below 1. Weights are in [0, 1].
        """
        by_error_counts = np.zeros_like(sample_counts)
        by_error_counts[:, PIXEL_CLASSES.index("body")] = np.rint(
            error_ratio * sample_counts[:, PIXEL_CLASSES.index("body")]
        )
        uniform_counts = count_uniforms(sample_counts, by_error_counts).tolist()
        uniforms = np.concatenate([rng.random(count) for rng, count in zip(rngs, uniform_counts, strict=True)])
        return sample_pixels(
            PixelLists(self.start, self.xy_px),
            SampleCounts(frames, sample_counts, by_error_counts),
            TileErrors(error_map.error, TILE_PX, outlier_threshold),
            uniforms,
        )


def posed_space_cameras(camera: Camera, world_to_posed: Float[np.ndarray, "frames 4 4"]) -> PosedCameras:
    """Transform the camera to the posed space of each frame; `world_to_posed` are rigid transforms."""
    rotation, translation_m = world_to_posed[:, :3, :3], world_to_posed[:, :3, 3]
    intrinsics = np.array([[camera.fx, camera.fy], [camera.cx, camera.cy]], np.float32)
    origin_m, axes = rotation @ camera.centre_m() + translation_m, rotation @ camera.world_to_camera[:3, :3].T
    return PosedCameras(
        intrinsics[0], intrinsics[1], origin_m.astype(np.float32), np.ascontiguousarray(axes, np.float32)
    )


def build_pixel_pool(
    images: Iterable[tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]], border_px: int, seed: int
) -> PixelPool:
    """Classify the pixels of each (image, mask).

    border_px: half width of the band around the mask border. Outside pixels come from the bounding box of the mask,
    widened by a tenth of its height, at most `MAX_OUTSIDE_PIXELS_PER_FRAME` random ones per frame.
    """
    xy, rgba, starts, total = [], [], [], 0
    for index, (image, mask) in enumerate(images):
        start = [total]
        for rows, columns in _classify_pixels(mask, border_px, np.random.default_rng((seed, index))):
            xy.append(np.stack([columns, rows], axis=-1).astype(np.int16))
            rgba.append(np.concatenate([image[rows, columns], mask[rows, columns, None]], axis=-1))
            total += len(rows)
            start.append(total)
        starts.append(start)
    return PixelPool(np.concatenate(xy), np.concatenate(rgba), np.array(starts, dtype=np.int64))


def _classify_pixels(
    mask: UInt8[np.ndarray, "h w"], border_px: int, rng: np.random.Generator
) -> list[tuple[Int[np.ndarray, "p"], Int[np.ndarray, "p"]]]:
    """Return (rows, columns) of the body, border and outside pixels of one mask."""
    sides = [np.flatnonzero((mask >= 128).any(axis=axis)) for axis in (1, 0)]
    if not len(sides[0]):
        return [(sides[0], sides[1])] * len(PIXEL_CLASSES)
    # Corners of the bounding box of the mask dilated by `border_px`; outside pixels are at most `pad` away from it.
    low, high = (
        np.clip([side[end] + sign * border_px for side in sides], 0, np.array(mask.shape) - 1)
        for end, sign in ((0, -1), (-1, 1))
    )
    pad = 8 + int(0.1 * (high[0] - low[0] + 1))
    first = np.maximum(low - pad, 0)
    mask = mask[first[0] : high[0] + pad, first[1] : high[1] + pad]
    solid = (mask >= 128).astype(np.uint8)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * border_px + 1, 2 * border_px + 1))
    outer, inner = cv2.dilate(solid, kernel), cv2.erode(solid, kernel, borderValue=(0,))
    border = (outer > inner) | ((mask > 0) & (mask < 255) & (outer > 0))
    outside_index = np.flatnonzero((outer == 0) & (mask == 0))
    if len(outside_index) > MAX_OUTSIDE_PIXELS_PER_FRAME:
        outside_index = np.sort(rng.choice(outside_index, MAX_OUTSIDE_PIXELS_PER_FRAME, replace=False))
    by_class = np.nonzero(solid & ~border), np.nonzero(border), np.unravel_index(outside_index, mask.shape)
    return [(rows + first[0], columns + first[1]) for rows, columns in by_class]
