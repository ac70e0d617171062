"""Plain-numpy reference of pixel sampling: one frame and one pixel class after the other."""

import numpy as np

from pipeline.kernels.pixel_sampling import CANDIDATES_PER_SAMPLE, PixelLists, PosedCameras, SampleCounts, TileErrors


def sample_pixels(
    pixels: PixelLists, samples: SampleCounts, tiles: TileErrors, uniforms: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Do `pipeline.kernels.pixel_sampling.sample_pixels`."""
    remaining = uniforms
    rows: list[np.ndarray] = [np.zeros(0, np.int64)]
    confidence: list[np.ndarray] = [np.zeros(0)]

    def stratified(count: int) -> np.ndarray:
        nonlocal remaining
        taken, remaining = remaining[:count], remaining[count:]
        return (np.arange(count) + taken) / max(count, 1)

    for frame, counts, error_sampled_counts in zip(*samples, strict=True):
        limit = np.inf
        for pixel_class, (count, error_sampled) in enumerate(zip(counts, error_sampled_counts, strict=True)):
            available = np.arange(pixels.offsets[frame, pixel_class], pixels.offsets[frame, pixel_class + 1])
            drawn = available[(stratified(count - error_sampled) * len(available)).astype(np.int64)]
            if pixel_class == 0 and len(drawn):
                limit = tiles.outlier_ratio * np.median(_tile_errors(drawn, pixels, tiles, frame))
            if error_sampled:
                positions = stratified(CANDIDATES_PER_SAMPLE * error_sampled)
                candidates = available[(positions * len(available)).astype(np.int64)]
                cumulative = np.cumsum(np.minimum(_tile_errors(candidates, pixels, tiles, frame), limit))
                index = np.searchsorted(cumulative, stratified(error_sampled) * cumulative[-1], side="right")
                drawn = np.concatenate([drawn, candidates[index.clip(max=len(candidates) - 1)]])
            rows.append(drawn)
        frame_rows = np.concatenate(rows[-len(counts) :])
        confidence.append(np.minimum(1.0, limit / _tile_errors(frame_rows, pixels, tiles, frame)) ** 4)
    return np.concatenate(rows), np.concatenate(confidence).astype(np.float32)


def _tile_errors(rows: np.ndarray, pixels: PixelLists, tiles: TileErrors, frame: int) -> np.ndarray:
    x, y = pixels.xy_px[rows].T // tiles.tile_px
    return tiles.error[frame][y, x].astype(np.float64).clip(1e-12)


def generate_pixel_rays(
    rows: np.ndarray,
    frame: np.ndarray,
    xy_px: np.ndarray,
    rgba: np.ndarray,
    pixel_offset_px: np.ndarray,
    cameras: PosedCameras,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Do `pipeline.kernels.pixel_sampling.generate_pixel_rays`."""
    plane = (xy_px[rows] + pixel_offset_px - cameras.centre_px) / cameras.focal_px
    in_camera = np.concatenate([plane, np.ones((len(rows), 1))], axis=1)
    along = (cameras.axes[frame] * in_camera[:, None]).sum(axis=2)
    return (
        cameras.origin_m[frame],
        along / np.linalg.norm(in_camera, axis=1, keepdims=True),
        rgba[rows] / np.float32(255),
    )


def update_error_map(
    rows: np.ndarray,
    frame: np.ndarray,
    xy_px: np.ndarray,
    colour_error: np.ndarray,
    decay: float,
    tile_px: int,
    error: np.ndarray,
) -> None:
    """Do `pipeline.kernels.pixel_sampling.update_error_map`."""
    x, y = xy_px[rows].T // tile_px
    tile = np.ravel_multi_index((frame, y, x), error.shape)
    count, total = np.bincount(tile), np.bincount(tile, np.abs(colour_error).mean(axis=1))
    seen = np.flatnonzero(count)
    retained, flat_error = decay ** count[seen], error.reshape(-1)
    flat_error[seen] = retained * flat_error[seen] + (1 - retained) * total[seen] / count[seen]
