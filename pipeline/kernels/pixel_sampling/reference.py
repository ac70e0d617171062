"""Plain twin of the draws of a training step: one frame, one kind and one pixel after the other."""

import numpy as np

from pipeline.kernels.pixel_sampling import CANDIDATES, Eyes


def draw_pixels(
    start: np.ndarray,
    xy_px: np.ndarray,
    frames: np.ndarray,
    sizes: np.ndarray,
    chosen: np.ndarray,
    error: np.ndarray,
    tile_px: int,
    outlier: float,
    numbers: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Same as `pipeline.kernels.pixel_sampling.draw_pixels`."""
    left = numbers
    rows: list[np.ndarray] = [np.zeros(0, np.int64)]
    trust: list[np.ndarray] = [np.zeros(0)]

    def stratified(count: int) -> np.ndarray:
        nonlocal left
        taken, left = left[:count], left[count:]
        return (np.arange(count) + taken) / max(count, 1)

    for slot, frame in enumerate(frames):
        limit = np.inf
        for kind, (count, by_error) in enumerate(zip(sizes[slot], chosen[slot], strict=True)):
            pixels = np.arange(start[frame, kind], start[frame, kind + 1])
            drawn = pixels[(stratified(count - by_error) * len(pixels)).astype(np.int64)]
            if kind == 0 and len(drawn):
                limit = outlier * np.median(_tile_errors(drawn, xy_px, error[frame], tile_px))
            if by_error:
                candidates = pixels[(stratified(CANDIDATES * by_error) * len(pixels)).astype(np.int64)]
                reached = np.cumsum(np.minimum(_tile_errors(candidates, xy_px, error[frame], tile_px), limit))
                place = np.searchsorted(reached, stratified(by_error) * reached[-1], side="right")
                drawn = np.concatenate([drawn, candidates[place.clip(max=len(candidates) - 1)]])
            rows.append(drawn)
        of_frame = np.concatenate(rows[-len(sizes[slot]) :])
        trust.append(np.minimum(1.0, limit / _tile_errors(of_frame, xy_px, error[frame], tile_px)) ** 4)
    return np.concatenate(rows), np.concatenate(trust).astype(np.float32)


def _tile_errors(rows: np.ndarray, xy_px: np.ndarray, error: np.ndarray, tile_px: int) -> np.ndarray:
    x, y = xy_px[rows].T // tile_px
    return error[y, x].astype(np.float64).clip(1e-12)


def pixel_rays(
    rows: np.ndarray, frame: np.ndarray, xy_px: np.ndarray, rgba: np.ndarray, inside_px: np.ndarray, eyes: Eyes
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Same as `pipeline.kernels.pixel_sampling.pixel_rays`."""
    plane = (xy_px[rows] + inside_px - eyes.centre_px) / eyes.focal_px
    in_camera = np.concatenate([plane, np.ones((len(rows), 1))], axis=1)
    along = (eyes.axes[frame] * in_camera[:, None]).sum(axis=2)
    return eyes.origin_m[frame], along / np.linalg.norm(in_camera, axis=1, keepdims=True), rgba[rows] / np.float32(255)


def note_errors(
    rows: np.ndarray,
    frame: np.ndarray,
    xy_px: np.ndarray,
    erred: np.ndarray,
    memory: float,
    tile_px: int,
    error: np.ndarray,
) -> None:
    """Same as `pipeline.kernels.pixel_sampling.note_errors`."""
    x, y = xy_px[rows].T // tile_px
    tile = np.ravel_multi_index((frame, y, x), error.shape)
    count, total = np.bincount(tile), np.bincount(tile, np.abs(erred).mean(axis=1))
    seen = np.flatnonzero(count)
    kept, known = memory ** count[seen], error.reshape(-1)
    known[seen] = kept * known[seen] + (1 - kept) * total[seen] / count[seen]
