"""Ray marching: the samples of each ray at which the canonical field is evaluated.

Each ray passes through the posed bounding box of its frame in steps of constant length. Each step is looked up in the
warp grid of the frame and kept if its canonical point is in an occupied cell. The samples are packed, ray after ray.

Notation: n rays, s samples.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.kernels.common.dispatch import runs_on_cuda, runs_on_numba
from pipeline.kernels.march import cpu, reference
from pipeline.kernels.march.cpu import RayArrays
from pipeline.kernels.march.inputs import PackedWarpGrids, Rays, SamplingVolume

__all__ = ["PackedWarpGrids", "Rays", "Samples", "SamplingVolume", "march"]


@dataclass(frozen=True)
class Samples:
    """Packed samples: canonical position, distance along the ray, and first sample of each ray (n + 1 offsets)."""

    canonical_m: Float[Tensor, "s 3"]
    distance_m: Float[Tensor, "s"]
    ray_offsets: Int[Tensor, "m"]


def march(rays: Rays, volume: SamplingVolume, step_m: float, max_samples: int = 160) -> Samples:
    """Sample rays in occupied cells.

    A step in a posed cell with several inverses gives one sample for each inverse that is occupied, all at the same
    distance. Samples of a ray after the first `max_samples` are dropped.
    """
    if runs_on_cuda(rays.origins_m, rays.directions, rays.jitter):
        from pipeline.kernels.march import cuda  # only where there is a GPU

        samples, ray_offsets = cuda.march(rays, volume, step_m, max_samples)
        return Samples(samples.canonical, samples.distance, ray_offsets)
    if not runs_on_numba(rays.origins_m, rays.directions, rays.jitter):
        return Samples(*reference.march(rays, volume, step_m, max_samples))
    ray_arrays = RayArrays(*(tensor.contiguous().numpy() for tensor in rays))
    points, distance, ray_offsets = cpu.march(
        ray_arrays, np.float32(step_m), volume.warps.arrays, volume.occupancy_arrays, max_samples
    )
    return Samples(torch.from_numpy(points), torch.from_numpy(distance), torch.from_numpy(ray_offsets))
