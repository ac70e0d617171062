"""Plain twin of the draws of a training step: one frame, one kind and one pixel after the other."""

import numpy as np

from pipeline.kernels.pixel_sampling import CANDIDATES_PER_SAMPLE, PosedCameras


def sample_pixels(
    kind_offsets: np.ndarray,
    xy_px: np.ndarray,
    frames: np.ndarray,
    sizes: np.ndarray,
    error_sampled_sizes: np.ndarray,
    error: np.ndarray,
    tile_px: int,
    outlier_ratio: float,
    uniforms: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Same as `pipeline.kernels.pixel_sampling.sample_pixels`."""
    remaining = uniforms
    rows: list[np.ndarray] = [np.zeros(0, np.int64)]
    confidence: list[np.ndarray] = [np.zeros(0)]

    def stratified(count: int) -> np.ndarray:
        nonlocal remaining
        taken, remaining = remaining[:count], remaining[count:]
        return (np.arange(count) + taken) / max(count, 1)

    for batch_index, frame in enumerate(frames):
        limit = np.inf
        for kind, (count, error_sampled) in enumerate(
            zip(sizes[batch_index], error_sampled_sizes[batch_index], strict=True)
        ):
            pixels = np.arange(kind_offsets[frame, kind], kind_offsets[frame, kind + 1])
            drawn = pixels[(stratified(count - error_sampled) * len(pixels)).astype(np.int64)]
            if kind == 0 and len(drawn):
                limit = outlier_ratio * np.median(_tile_errors(drawn, xy_px, error[frame], tile_px))
            if error_sampled:
                candidates = pixels[(stratified(CANDIDATES_PER_SAMPLE * error_sampled) * len(pixels)).astype(np.int64)]
                cumulative = np.cumsum(np.minimum(_tile_errors(candidates, xy_px, error[frame], tile_px), limit))
                place = np.searchsorted(cumulative, stratified(error_sampled) * cumulative[-1], side="right")
                drawn = np.concatenate([drawn, candidates[place.clip(max=len(candidates) - 1)]])
            rows.append(drawn)
        frame_rows = np.concatenate(rows[-len(sizes[batch_index]) :])
        confidence.append(np.minimum(1.0, limit / _tile_errors(frame_rows, xy_px, error[frame], tile_px)) ** 4)
    return np.concatenate(rows), np.concatenate(confidence).astype(np.float32)


def _tile_errors(rows: np.ndarray, xy_px: np.ndarray, error: np.ndarray, tile_px: int) -> np.ndarray:
    x, y = xy_px[rows].T // tile_px
    return error[y, x].astype(np.float64).clip(1e-12)


def generate_pixel_rays(
    rows: np.ndarray,
    frame: np.ndarray,
    xy_px: np.ndarray,
    rgba: np.ndarray,
    pixel_offset_px: np.ndarray,
    cameras: PosedCameras,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Same as `pipeline.kernels.pixel_sampling.generate_pixel_rays`."""
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
    """Same as `pipeline.kernels.pixel_sampling.update_error_map`."""
    x, y = xy_px[rows].T // tile_px
    tile = np.ravel_multi_index((frame, y, x), error.shape)
    count, total = np.bincount(tile), np.bincount(tile, np.abs(colour_error).mean(axis=1))
    seen = np.flatnonzero(count)
    retained, flat_error = decay ** count[seen], error.reshape(-1)
    flat_error[seen] = retained * flat_error[seen] + (1 - retained) * total[seen] / count[seen]
