"""What rays see of the canonical field, wherever the poses carry it; differentiable in field and poses.

Letters: n rays, b frames of a batch, j joints, p points.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.field.field import INITIAL_DENSITY_PER_M, MAX_ABS_LOG_DENSITY, RadianceField
from pipeline.field.inverse_skinning import InverseSkinning, Rays
from pipeline.field.occupancy import BinaryOccupancy
from pipeline.kernels.common.dispatch import runs_on_numba
from pipeline.kernels.common.packing import segment_ids_from_counts
from pipeline.kernels.composite import composite
from pipeline.kernels.hashgrid import FeatureGradients
from pipeline.kernels.inverse_skinning import SkinGrid
from pipeline.kernels.march import Samples
from pipeline.kernels.transmittance_stats import transmittance_from_weights
from pipeline.kernels.volume_rendering import BatchSkinning, RadianceNetwork, RenderOutput, SamplingVolume, trace


class PoseBatch(NamedTuple):
    """Where samples are carried: skin weights, and the skinning matrices of the batch's frames, which are in order."""

    skin: SkinGrid
    frames: Int[Tensor, "b"]
    canonical_to_posed: Float[Tensor, "b j 4 4"]

    def blended(self) -> Float[Tensor, "m b 12"]:
        """The matrices at the nodes of the skin grid."""
        return self.skin.blend(self.canonical_to_posed)

    def frame_slots(self, rays: Rays) -> Int[Tensor, "n"]:
        """Which of the frames each ray belongs to."""
        return torch.searchsorted(self.frames, rays.frame)


def uses_early_termination(field: RadianceField, inverse: InverseSkinning) -> bool:
    """Whether `render_rays` asks only for what light reaches: a hash grid behind warp grids, on the CPU."""
    return inverse.warps is not None and field.trunk is None and runs_on_numba(field.table)


def render_rays(
    field: RadianceField,
    inverse: InverseSkinning,
    occupancy: BinaryOccupancy,
    rays: Rays,
    pose_batch: PoseBatch | None,
    points_m: Float[Tensor, "p 3"],
    step_m: float,
    max_samples: int,
    feature_gradients: FeatureGradients,
) -> RenderOutput:
    """Colour and alpha of rays, density of some more points, and what the samples saw.

    rays: their frames are rows of the motion that `inverse` undoes, in order.
    placing: None: samples lie where `inverse` found them.
    towards: takes what the hash table's gradient is made of (`pipeline.kernels.hashgrid.encode`).
    """
    warps = inverse.warps
    if warps is None or not uses_early_termination(field, inverse):
        return render_rays_dense(
            field, inverse, occupancy, rays, pose_batch, points_m, step_m, max_samples, feature_gradients
        )
    network = (field.hidden, field.output, field.bias)
    return trace(
        *rays,
        SamplingVolume(warps, occupancy.occupied, occupancy.bounds_m),
        RadianceNetwork(
            field.bounds_m, field.table, field.layout, *network, INITIAL_DENSITY_PER_M, MAX_ABS_LOG_DENSITY
        ),
        BatchSkinning(pose_batch.skin, pose_batch.blended(), pose_batch.frame_slots(rays)) if pose_batch else None,
        points_m,
        step_m,
        max_samples,
        feature_gradients,
    )


def render_rays_dense(
    field: RadianceField,
    inverse: InverseSkinning,
    occupancy: BinaryOccupancy,
    rays: Rays,
    pose_batch: PoseBatch | None,
    points_m: Float[Tensor, "p 3"],
    step_m: float,
    max_samples: int,
    feature_gradients: FeatureGradients,
) -> RenderOutput:
    """`render_rays` with any inverse, field and device: all samples at once, those behind a surface too."""
    samples = inverse.sample_rays(rays, step_m, occupancy, max_samples)
    count = len(samples.distance_m)
    sample_positions_m = _to_canonical(inverse, rays, pose_batch, samples) if pose_batch else samples.canonical_m
    colour, density = field.radiance(torch.cat([sample_positions_m, points_m]), feature_gradients)
    step = torch.full_like(samples.distance_m, step_m)
    image, alpha, weight = composite(density[:count], colour[:count], step, samples.ray_offsets)
    transmittance = transmittance_from_weights(weight, samples.ray_offsets)
    return RenderOutput(image, alpha, density[count:], samples.canonical_m, transmittance, weight.detach())


def _to_canonical(
    inverse: InverseSkinning, rays: Rays, pose_batch: PoseBatch, samples: Samples
) -> Float[Tensor, "s 3"]:
    """Where the poses carry samples, differentiably."""
    ray = segment_ids_from_counts(samples.ray_offsets.diff())
    # Rows by index_select: plain indexing takes three times as long for tensors of this size.
    offset = samples.distance_m[:, None] * rays.directions.index_select(0, ray)
    posed = rays.origins_m.index_select(0, ray) + offset
    skin, frames, matrices = pose_batch
    slots = torch.arange(len(frames) + 1, device=frames.device)
    frame_offsets = samples.ray_offsets[torch.searchsorted(pose_batch.frame_slots(rays), slots)]
    return inverse.to_canonical(skin, matrices, frames, samples.canonical_m, posed, frame_offsets)
