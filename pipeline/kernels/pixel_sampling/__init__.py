"""Random pixels of some frames and the rays through them; where colours were wrong, for later draws.

All of it stays on the CPU, wherever the field is: a step draws from a pool of pixels too large for a graphics card.

Letters: p pixels of all frames, k frames of the batch, q kinds of pixels, n rays.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8

from pipeline.kernels.pixel_sampling import cpu as draw_cpu

CANDIDATES = draw_cpu.CANDIDATES


class Eyes(NamedTuple):
    """How frames are seen: focal lengths and image centre in pixels; and for each frame, in its own space, the pinhole
    and the camera's axes (columns).
    """

    focal_px: Float[np.ndarray, "2"]
    centre_px: Float[np.ndarray, "2"]
    origin_m: Float[np.ndarray, "frames 3"]
    axes: Float[np.ndarray, "frames 3 3"]


def numbers_needed(sizes: Int[np.ndarray, "k q"], chosen: Int[np.ndarray, "k q"]) -> Int[np.ndarray, "k"]:
    """Random numbers that `draw_pixels` takes for each frame."""
    return (sizes + CANDIDATES * chosen).sum(axis=1)


def draw_pixels(
    start: Int[np.ndarray, "frames q+1"],
    xy_px: Int[np.ndarray, "p 2"],
    frames: Int[np.ndarray, "k"],
    sizes: Int[np.ndarray, "k q"],
    chosen: Int[np.ndarray, "k q"],
    error: Float[np.ndarray, "frames rows columns"],
    tile_px: int,
    outlier: float,
    numbers: Float[np.ndarray, "r"],
) -> tuple[Int[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Rows of pixels, frame by frame and kind by kind: so many as `sizes` says, the kind q of frame f from
    start[f, q] : start[f, q + 1]; and the trust in each, in [0, 1].

    Stratified: the i-th of m draws comes from the i-th of m equal parts of the list. The last `chosen` of a kind are
    resampled from `CANDIDATES` times as many of these, each as likely as the `error` of its tile (`tile_px` wide) has
    it. numbers: uniform in [0, 1), as many as `numbers_needed` says, in the order of the draws.

    A tile whose error is more than `outlier` medians shows something else than what is learnt: a ball, a passer-by. It
    is drawn no oftener than one at that limit, and the trust in it is the fourth power of limit over error. The median
    is that of a frame's plain draws of the first kind; without any, everything is trusted.
    """
    rows, trust = np.empty(int(sizes.sum()), np.int64), np.empty(int(sizes.sum()), np.float32)
    draw_cpu.draw_rows(start, xy_px, frames, sizes, chosen, error, tile_px, outlier, numbers, rows, trust)
    return rows, trust


def pixel_rays(
    rows: Int[np.ndarray, "n"],
    frame: Int[np.ndarray, "n"],
    xy_px: Int[np.ndarray, "p 2"],
    rgba: UInt8[np.ndarray, "p 4"],
    inside_px: Float[np.ndarray, "n 2"],
    eyes: Eyes,
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], Float[np.ndarray, "n 4"]]:
    """Origins (m) and unit directions of rays, in the space of their frame, and what their pixels show, in [0, 1].

    inside_px: where in the pixel its ray goes, in [0, 1).
    """
    origins, directions = (np.empty((len(rows), 3), np.float32) for _ in range(2))
    shown = np.empty((len(rows), 4), np.float32)
    draw_cpu.pixel_rays(rows, frame, xy_px, rgba, inside_px, *eyes, origins, directions, shown)
    return origins, directions, shown


def note_errors(
    rows: Int[np.ndarray, "n"],
    frame: Int[np.ndarray, "n"],
    xy_px: Int[np.ndarray, "p 2"],
    erred: Float[np.ndarray, "n 3"],
    memory: float,
    tile_px: int,
    error: Float[np.ndarray, "frames rows columns"],
) -> None:
    """Take into `error`, in place, what pixels erred by, those of a frame side by side: where m are new in a tile, its
    old error keeps the part memory^m, and their mean absolute error makes up the rest.
    """
    draw_cpu.note_errors(rows, frame, xy_px, erred, memory, tile_px, error)
