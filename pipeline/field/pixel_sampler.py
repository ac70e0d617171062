"""The pixels that training draws from: on the body, along its border, and a few outside."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from pipeline.geometry.camera import Camera
from pipeline.kernels.pixel_sampling import Eyes, draw_pixels, note_errors, numbers_needed

KINDS = ("body", "border", "outside")
OUTSIDE_PER_FRAME = 20_000
TILE_PX = 16
MEMORY = 0.8
"""What is left of a tile's error at each new pixel of it."""


class ErrorMap:
    """Where the learning errs: the mean colour error of late in every tile of every frame."""

    def __init__(self, frames: int, xy_px: Int[np.ndarray, "p 2"]) -> None:
        """All tiles alike. xy_px: every pixel that will ever be asked for."""
        self.xy_px = xy_px
        columns, rows = xy_px.max(axis=0) // TILE_PX + 1
        self.error = np.ones((frames, rows, columns), dtype=np.float32)

    def note(self, rows: Int[np.ndarray, "n"], frame: Int[np.ndarray, "n"], erred: Float[np.ndarray, "n 3"]) -> None:
        """Take in what pixels of some frames, those of a frame side by side, erred by in colour."""
        note_errors(rows, frame, self.xy_px, erred, MEMORY, TILE_PX, self.error)


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

    def sizes(
        self, frames: Int[np.ndarray, "k"], rays: float, shares: tuple[float, float, float]
    ) -> Int[np.ndarray, "k kinds"]:
        """How many pixels of each kind `draw` takes of each frame, when a frame has `rays` in all; none of a kind that
        a frame is without. shares: parts of the rays on the body, its border and outside.
        """
        wanted = np.rint(rays * np.array(shares)).astype(np.int64)
        return wanted * (np.diff(self.start[frames], axis=1) > 0)

    def draw(
        self,
        frames: Int[np.ndarray, "k"],
        sizes: Int[np.ndarray, "k kinds"],
        streams: Sequence[np.random.Generator],
        errors: ErrorMap,
        by_error: float = 0.0,
        outlier: float = np.inf,
    ) -> tuple[Int[np.ndarray, "n"], Float[np.ndarray, "n"]]:
        """Rows of random pixels of some frames, so many of each kind, evenly spread over the pixels of their kind; and
        the trust in each, in [0, 1].

        streams: of random numbers, one for each frame, so that its pixels hang on it alone. by_error: part of the rays
        on the body that goes where `errors` are large. outlier: how large they may be in a frame, in medians, before
        they tell that something else than the person is seen there.
        """
        chosen = np.zeros_like(sizes)
        chosen[:, KINDS.index("body")] = np.rint(by_error * sizes[:, KINDS.index("body")])
        needed = numbers_needed(sizes, chosen).tolist()
        numbers = np.concatenate([stream.random(count) for stream, count in zip(streams, needed, strict=True)])
        return draw_pixels(self.start, self.xy_px, frames, sizes, chosen, errors.error, TILE_PX, outlier, numbers)


def eyes(camera: Camera, posed_from_world: Float[np.ndarray, "frames 4 4"]) -> Eyes:
    """How the camera sees each frame's posed space."""
    turn, shift = posed_from_world[:, :3, :3], posed_from_world[:, :3, 3]
    lens = np.array([[camera.fx, camera.fy], [camera.cx, camera.cy]], np.float32)
    origin_m, axes = turn @ camera.centre_m() + shift, turn @ camera.world_to_camera[:3, :3].T
    return Eyes(lens[0], lens[1], origin_m.astype(np.float32), np.ascontiguousarray(axes, np.float32))


def build_pool(
    images: Iterable[tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]], border_px: int, seed: int
) -> PixelPool:
    """Sort the pixels of each (image, mask) into the three kinds.

    border_px: half width of the band around the mask's edge. Outside pixels come from the body's box, widened by a
    tenth, and are thinned to a fixed number a frame.
    """
    xy, rgba, starts, total = [], [], [], 0
    for index, (image, mask) in enumerate(images):
        start = [total]
        for place in _kinds(mask, border_px, np.random.default_rng((seed, index))):
            rows, columns = place
            xy.append(np.stack([columns, rows], axis=-1).astype(np.int16))
            rgba.append(np.concatenate([image[rows, columns], mask[rows, columns, None]], axis=-1))
            total += len(rows)
            start.append(total)
        starts.append(start)
    return PixelPool(np.concatenate(xy), np.concatenate(rgba), np.array(starts, dtype=np.int64))


def _kinds(mask: UInt8[np.ndarray, "h w"], border_px: int, random: np.random.Generator) -> list[tuple]:
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
    far = np.flatnonzero(outside)
    if len(far) > OUTSIDE_PER_FRAME:
        far = np.sort(random.choice(far, OUTSIDE_PER_FRAME, replace=False))
    return [np.nonzero(solid & ~border), np.nonzero(border), np.unravel_index(far, mask.shape)]
