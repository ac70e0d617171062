"""Random pixels of some frames, the rays through them, and the error map that later draws use.

All of it runs on the CPU, wherever the field is: a step draws from a pool of pixels too large for a graphics card.

Notation: p pixels of all frames, k frames of the batch, q pixel classes, n rays.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8

from pipeline.kernels.pixel_sampling import cpu

CANDIDATES_PER_SAMPLE = cpu.CANDIDATES_PER_SAMPLE


class PixelLists(NamedTuple):
    """Pixels, frame by frame and class by class: those of class q of frame f are offsets[f, q] : offsets[f, q + 1].

    xy_px: column and row of each pixel.
    """

    offsets: Int[np.ndarray, "frames q1"]
    xy_px: Int[np.ndarray, "p 2"]


class SampleCounts(NamedTuple):
    """Number of pixels to draw from each class of each frame, and how many of them by error sampling."""

    frames: Int[np.ndarray, "k"]
    counts: Int[np.ndarray, "k q"]
    error_sampled: Int[np.ndarray, "k q"]


class TileErrors(NamedTuple):
    """Mean colour error of each tile of `tile_px` x `tile_px` pixels.

    outlier_ratio: limit of the error, in medians of the frame. A tile above it shows something else than the person.
    """

    error: Float[np.ndarray, "frames rows columns"]
    tile_px: int
    outlier_ratio: float


class PosedCameras(NamedTuple):
    """Pinhole cameras of the frames: intrinsics, and in the posed space of each frame the camera centre and the camera
    axes (columns).
    """

    focal_px: Float[np.ndarray, "2"]
    centre_px: Float[np.ndarray, "2"]
    origin_m: Float[np.ndarray, "frames 3"]
    axes: Float[np.ndarray, "frames 3 3"]


def count_uniforms(
    counts: Int[np.ndarray, "k q"], error_sampled_counts: Int[np.ndarray, "k q"]
) -> Int[np.ndarray, "k"]:
    """Return the number of uniform random numbers that `sample_pixels` uses for each frame."""
    return (counts + CANDIDATES_PER_SAMPLE * error_sampled_counts).sum(axis=1)


def sample_pixels(
    pixels: PixelLists, samples: SampleCounts, tiles: TileErrors, uniforms: Float[np.ndarray, "r"]
) -> tuple[Int[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Draw pixels; return their rows in `pixels`, frame by frame and class by class, and their confidence in [0, 1].

    Sampling is stratified: the i-th of m samples comes from the i-th of m equal parts of the list. The last
    `error_sampled` samples of a class are resampled from `CANDIDATES_PER_SAMPLE` times as many stratified candidates,
    with probabilities proportional to the error of their tiles.

    The error of a tile is clamped to the limit, `outlier_ratio` times the median error of the uniform samples of the
    frame's first class (no limit without such samples). The confidence is min(1, limit / error) ** 4.

    uniforms: in [0, 1), `count_uniforms` of them, in the order of the samples.
    """
    total = int(samples.counts.sum())
    rows, confidence = np.empty(total, np.int64), np.empty(total, np.float32)
    cpu.sample_pixels(pixels, samples, tiles, uniforms, rows, confidence)
    return rows, confidence


def generate_pixel_rays(
    rows: Int[np.ndarray, "n"],
    frame: Int[np.ndarray, "n"],
    xy_px: Int[np.ndarray, "p 2"],
    rgba: UInt8[np.ndarray, "p 4"],
    pixel_offset_px: Float[np.ndarray, "n 2"],
    cameras: PosedCameras,
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], Float[np.ndarray, "n 4"]]:
    """Return origins (m) and unit directions of rays in the posed space of their frames, and the RGBA of their pixels
    in [0, 1].

    pixel_offset_px: position of the ray within its pixel, in [0, 1).
    """
    rays = cpu.PixelRays(*(np.empty((len(rows), size), np.float32) for size in (3, 3, 4)))
    cpu.generate_pixel_rays(rows, frame, xy_px, rgba, pixel_offset_px, cameras, rays)
    return rays.origins, rays.directions, rays.rgba


def update_error_map(
    rows: Int[np.ndarray, "n"],
    frame: Int[np.ndarray, "n"],
    xy_px: Int[np.ndarray, "p 2"],
    colour_error: Float[np.ndarray, "n 3"],
    decay: float,
    tile_px: int,
    error: Float[np.ndarray, "frames rows columns"],
) -> None:
    """Update the error map in place: e = decay^m e + (1 - decay^m) mean|colour_error|, for a tile with m new pixels.

    The pixels of a frame are consecutive.
    """
    cpu.update_error_map(rows, frame, xy_px, colour_error, decay, tile_px, error)
