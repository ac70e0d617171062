"""Rays of a training step: which frames, which pixels, and their random numbers.

Random numbers come from generators keyed by seed, step and stream, so that a resumed training draws the same numbers as
an uninterrupted one, and the rays of a frame do not depend on how a step is divided among threads.

Letters: n rays, k frames of a batch.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.field.config import FieldConfig
from pipeline.field.inverse_skinning import Rays
from pipeline.field.pixel_sampler import ErrorMap, PixelPool
from pipeline.kernels.pixel_sampling import PosedCameras, generate_pixel_rays

STEP_STREAM, POINT_STREAM, FRAME_STREAM = range(3)
"""Streams of random numbers of a step: choice of frames and occupancy, empty points, and one stream per frame."""


def step_rng(seed: int, step: int, stream: int) -> np.random.Generator:
    """Return the random generator of one stream of a training step."""
    return np.random.Generator(np.random.Philox(key=[seed, step], counter=[0, 0, 0, stream]))


@dataclass(frozen=True)
class RayBatch:
    """Rays of some frames, in the posed space of their frame, ordered by frame.

    frame_indices: frames of the batch. frame_index: frame of each ray. pixel_index: row of each ray in the pixel pool.
    rgba: colour and mask of the pixel, in [0, 1]. background: random colour behind the ray. jitter: offset of the
    samples, as a fraction of a ray step. inlier_weight: weight in the losses, in [0, 1].
    """

    frame_indices: Int[Tensor, "k"]
    frame_index: Int[Tensor, "n"]
    pixel_index: Int[np.ndarray, "n"]
    origins_m: Float[Tensor, "n 3"]
    directions: Float[Tensor, "n 3"]
    rgba: Float[Tensor, "n 4"]
    background: Float[Tensor, "n 3"]
    jitter: Float[Tensor, "n"]
    inlier_weight: Float[Tensor, "n"]

    @property
    def rays(self) -> Rays:
        """The rays alone."""
        return Rays(self.origins_m, self.directions, self.frame_index, self.jitter)


class RaySampler:
    """Sampler of frames and pixels, with the error map that guides it.

    Raises:
        ValueError: no frame has a pixel to sample.
    """

    def __init__(self, pool: PixelPool, config: FieldConfig, device: torch.device) -> None:
        self.pool, self.config, self.device = pool, config, device
        self.error_map = ErrorMap(pool.frames, pool.xy_px)
        settings = config.settings
        class_ratios = (
            1 - settings.border_sampling_ratio - settings.outside_sampling_ratio,
            settings.border_sampling_ratio,
            settings.outside_sampling_ratio,
        )
        all_frames = np.arange(pool.frames)
        counts_if_alone = pool.sample_counts(all_frames, float(config.rays_per_step), class_ratios)
        self.frames_with_rays = np.flatnonzero(counts_if_alone.any(axis=1))
        if not len(self.frames_with_rays):
            raise ValueError("no training frame has a pixel to sample")
        self.frames_per_step = min(settings.frames_per_step, len(self.frames_with_rays))
        self.sample_counts = pool.sample_counts(all_frames, config.rays_per_step / self.frames_per_step, class_ratios)

    def sample_frames(self, rng: np.random.Generator) -> Int[np.ndarray, "k"]:
        """Draw the frames of a step, in ascending order."""
        return np.sort(rng.choice(self.frames_with_rays, self.frames_per_step, replace=False))

    def ray_fraction(self, part: Int[np.ndarray, "m"], frames: Int[np.ndarray, "k"]) -> float:
        """Return the number of rays of the frames `part`, as a fraction of those of all `frames`."""
        return float(self.sample_counts[part].sum() / self.sample_counts[frames].sum())

    def sample_rays(self, frames: Int[np.ndarray, "k"], step: int, cameras: PosedCameras) -> RayBatch:
        """Draw the rays of some frames in a step; those of a frame depend only on seed, step and frame.

        cameras: of all training frames, in their posed spaces.
        """
        settings, counts = self.config.settings, self.sample_counts[frames]
        rngs = [step_rng(self.config.seed, step, FRAME_STREAM + frame) for frame in frames.tolist()]
        pixel_index, inlier_weight = self.pool.sample_pixels(
            frames, counts, rngs, self.error_map, settings.error_sampling_ratio, settings.outlier_threshold
        )
        rays_per_frame = counts.sum(axis=1).tolist()
        uniform = np.concatenate(
            [rng.random((n, 6), dtype=np.float32) for rng, n in zip(rngs, rays_per_frame, strict=True)]
        )
        pixel_offset = uniform[:, 4:] if settings.pixel_jitter else np.full((len(pixel_index), 2), 0.5, np.float32)
        frame_index = np.repeat(frames, rays_per_frame)
        origins_m, directions, rgba = generate_pixel_rays(
            pixel_index, frame_index, self.pool.xy_px, self.pool.rgba, pixel_offset, cameras
        )
        return RayBatch(
            frame_indices=self._to_device(frames),
            frame_index=self._to_device(frame_index),
            pixel_index=pixel_index,
            origins_m=self._to_device(origins_m),
            directions=self._to_device(directions),
            rgba=self._to_device(rgba),
            background=self._to_device(uniform[:, :3]),
            jitter=self._to_device(uniform[:, 3]),
            # Pixels outside the mask are background whatever their error, so they keep the weight 1.
            inlier_weight=self._to_device(1 - rgba[:, 3] * (1 - inlier_weight)),
        )

    def update_errors(self, batch: RayBatch, colour_error: Float[Tensor, "n 3"]) -> None:
        """Update the error map with the colour errors of a batch, if it guides the sampling."""
        if self.config.settings.error_sampling_ratio > 0.0:
            self.error_map.update(batch.pixel_index, batch.frame_index.cpu().numpy(), colour_error.cpu().numpy())

    def _to_device(self, array: np.ndarray) -> Tensor:
        return torch.from_numpy(array).to(self.device)
