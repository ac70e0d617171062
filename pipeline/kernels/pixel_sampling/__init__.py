"""Random pixels of some frames and the rays through them; where colours were wrong, for later draws.

All of it stays on the CPU, wherever the field is: a step draws from a pool of pixels too large for a graphics card.

Letters: p pixels of all frames, k frames of the batch, q kinds of pixels, n rays.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8

from pipeline.kernels.pixel_sampling import cpu as draw_cpu

CANDIDATES_PER_SAMPLE = draw_cpu.CANDIDATES_PER_SAMPLE


class PosedCameras(NamedTuple):
    """How frames are seen: focal lengths and image centre in pixels; and for each frame, in its own space, the pinhole
    and the camera's axes (columns).
    """

    focal_px: Float[np.ndarray, "2"]
    centre_px: Float[np.ndarray, "2"]
    origin_m: Float[np.ndarray, "frames 3"]
    axes: Float[np.ndarray, "frames 3 3"]


def count_uniforms(sizes: Int[np.ndarray, "k q"], error_sampled_sizes: Int[np.ndarray, "k q"]) -> Int[np.ndarray, "k"]:
    """Random numbers that `sample_pixels` takes for each frame."""
    return (sizes + CANDIDATES_PER_SAMPLE * error_sampled_sizes).sum(axis=1)


def sample_pixels(
    kind_offsets: Int[np.ndarray, "frames q+1"],
    xy_px: Int[np.ndarray, "p 2"],
    frames: Int[np.ndarray, "k"],
    sizes: Int[np.ndarray, "k q"],
    error_sampled_sizes: Int[np.ndarray, "k q"],
    error: Float[np.ndarray, "frames rows columns"],
    tile_px: int,
    outlier_ratio: float,
    uniforms: Float[np.ndarray, "r"],
) -> tuple[Int[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Rows of pixels, frame by frame and kind by kind: so many as `sizes` says, the kind q of frame f from
    start[f, q] : start[f, q + 1]; and the trust in each, in [0, 1].

    Stratified: the i-th of m draws comes from the i-th of m equal parts of the list. The last `error_sampled_sizes`
    of a kind are
    resampled from `CANDIDATES_PER_SAMPLE` times as many of these, each as likely as the `error` of its tile
    (`tile_px` wide) has
    it. numbers: uniform in [0, 1), as many as `count_uniforms` says, in the order of the draws.

    A tile whose error is more than `outlier_ratio` medians shows something else than what is learnt: a ball, a
    passer-by. It
    is drawn no oftener than one at that limit, and the trust in it is the fourth power of limit over error. The median
    is that of a frame's plain draws of the first kind; without any, everything is trusted.
    """
    rows, confidence = np.empty(int(sizes.sum()), np.int64), np.empty(int(sizes.sum()), np.float32)
    draw_cpu.sample_pixels(
        kind_offsets,
        xy_px,
        frames,
        sizes,
        error_sampled_sizes,
        error,
        tile_px,
        outlier_ratio,
        uniforms,
        rows,
        confidence,
    )
    return rows, confidence


def generate_pixel_rays(
    rows: Int[np.ndarray, "n"],
    frame: Int[np.ndarray, "n"],
    xy_px: Int[np.ndarray, "p 2"],
    rgba: UInt8[np.ndarray, "p 4"],
    pixel_offset_px: Float[np.ndarray, "n 2"],
    cameras: PosedCameras,
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], Float[np.ndarray, "n 4"]]:
    """Origins (m) and unit directions of rays, in the space of their frame, and what their pixels show, in [0, 1].

    inside_px: where in the pixel its ray goes, in [0, 1).
    """
    origins, directions = (np.empty((len(rows), 3), np.float32) for _ in range(2))
    pixel_rgba = np.empty((len(rows), 4), np.float32)
    draw_cpu.generate_pixel_rays(rows, frame, xy_px, rgba, pixel_offset_px, *cameras, origins, directions, pixel_rgba)
    return origins, directions, pixel_rgba


def update_error_map(
    rows: Int[np.ndarray, "n"],
    frame: Int[np.ndarray, "n"],
    xy_px: Int[np.ndarray, "p 2"],
    colour_error: Float[np.ndarray, "n 3"],
    decay: float,
    tile_px: int,
    error: Float[np.ndarray, "frames rows columns"],
) -> None:
    """Take into `error`, in place, what pixels erred by, those of a frame side by side: where m are new in a tile, its
    old error keeps the part memory^m, and their mean absolute error makes up the rest.
    """
    draw_cpu.update_error_map(rows, frame, xy_px, colour_error, decay, tile_px, error)
