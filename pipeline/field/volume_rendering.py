"""Volume rendering of the canonical field along rays in posed space; differentiable in field and poses.

Letters: n rays, k frames of the motion, b frames of a batch, j joints, m nodes of the skin grid, p points, s samples.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.field.field import INITIAL_DENSITY_PER_M, MAX_ABS_LOG_DENSITY, RadianceField
from pipeline.field.inverse_skinning import InverseSkinning, Rays
from pipeline.field.occupancy import BinaryOccupancy
from pipeline.kernels.common.dispatch import runs_on_cuda, runs_on_numba
from pipeline.kernels.common.packing import segment_ids_from_counts
from pipeline.kernels.composite import composite
from pipeline.kernels.hashgrid import FeatureGradients
from pipeline.kernels.inverse_skinning import SkinGrid
from pipeline.kernels.march import Samples, SamplingVolume
from pipeline.kernels.transmittance_stats import transmittance_from_weights
from pipeline.kernels.volume_rendering import (
    BatchSkinning,
    OutputGradients,
    RadianceNetwork,
    RenderGradients,
    RenderOutput,
    RenderSettings,
    render_rays_fused,
)
from pipeline.kernels.volume_rendering import render_rays_with_gradients as fused_with_gradients


@dataclass(frozen=True)
class PosedField:
    """A canonical field, the inverse skinning of the frames in which it is seen, and its occupied cells.

    Valid until one of them changes.
    """

    field: RadianceField
    inverse: InverseSkinning
    occupancy: BinaryOccupancy

    @property
    def is_fused(self) -> bool:
        """Whether compiled kernels render: hash grid and warp grids, on the CPU or on a GPU with numba-cuda."""
        table = self.field.table
        is_compiled = runs_on_numba(table) or runs_on_cuda(table)
        return self.inverse.warps is not None and self.field.trunk is None and is_compiled

    @cached_property
    def network(self) -> RadianceNetwork:
        """The field for the fused renderer."""
        field, limits = self.field, (INITIAL_DENSITY_PER_M, MAX_ABS_LOG_DENSITY)
        weights = field.hidden, field.output, field.bias
        return RadianceNetwork(field.bounds_m, field.table, field.layout, *weights, *limits, field.gate)

    @cached_property
    def volume(self) -> SamplingVolume:
        """Warp grids and occupied cells for the fused renderer.

        Raises:
            TypeError: the inverse skinning has no warp grids.
        """
        if self.inverse.warps is None:
            raise TypeError("the inverse skinning has no warp grids")
        return SamplingVolume(self.inverse.warps, self.occupancy.occupied, self.occupancy.bounds_m)


class PoseBatch(NamedTuple):
    """Skin weights, and the skinning matrices of the frames of a batch; `frames` is in ascending order."""

    skin: SkinGrid
    frames: Int[Tensor, "b"]
    canonical_to_posed: Float[Tensor, "b j 4 4"]

    def split(self, sizes: Sequence[int]) -> list["PoseBatch"]:
        """Divide the frames into parts of some sizes; the poses of a part are leaves of autograd, beside the frames."""
        poses_of_parts = self.canonical_to_posed.detach().to(self.frames.device).split(sizes)
        parts = zip(self.frames.split(sizes), poses_of_parts, strict=True)
        return [PoseBatch(self.skin, frames, poses.requires_grad_()) for frames, poses in parts]

    def frame_slots(self, rays: Rays) -> Int[Tensor, "n"]:
        """Return the position in `frames` of each ray's frame."""
        return torch.searchsorted(self.frames, rays.frame_index)


def render_rays(
    posed_field: PosedField,
    rays: Rays,
    pose_batch: PoseBatch | None,
    points_m: Float[Tensor, "p 3"],
    step_m: float,
    max_samples: int,
    feature_gradients: FeatureGradients,
) -> RenderOutput:
    """Render colour and alpha of rays, and the density of further canonical points.

    rays: ordered by frame; frames are rows of the motion of `posed_field.inverse`. pose_batch: present poses, to which
    a Newton step moves the samples; None keeps the positions that the inverse skinning found. step_m: distance between
    samples, m. max_samples: per ray. feature_gradients: list that takes the contributions to the gradient of the hash
    table (`pipeline.kernels.hashgrid.encode`).
    """
    if not posed_field.is_fused:
        return render_rays_dense(posed_field, rays, pose_batch, points_m, step_m, max_samples, feature_gradients)
    fused = rays, posed_field.volume, posed_field.network, _batch_skinning(rays, pose_batch), points_m
    return render_rays_fused(*fused, RenderSettings(step_m, max_samples), feature_gradients)


def render_rays_with_gradients(
    posed_field: PosedField,
    rays: Rays,
    pose_batch: PoseBatch | None,
    points_m: Float[Tensor, "p 3"],
    step_m: float,
    max_samples: int,
    output_gradients: Callable[[Tensor, Tensor, Tensor], OutputGradients],
) -> tuple[RenderOutput, RenderGradients, FeatureGradients]:
    """Do `render_rays` and its backward pass without autograd, for a field that compiled kernels render.

    output_gradients: see `pipeline.kernels.volume_rendering.render_rays_with_gradients`.
    """
    fused = rays, posed_field.volume, posed_field.network, _batch_skinning(rays, pose_batch), points_m
    return fused_with_gradients(*fused, RenderSettings(step_m, max_samples), output_gradients)


def _batch_skinning(rays: Rays, pose_batch: PoseBatch | None) -> BatchSkinning | None:
    if pose_batch is None:
        return None
    return BatchSkinning(pose_batch.skin, pose_batch.canonical_to_posed, pose_batch.frame_slots(rays))


def render_rays_dense(
    posed_field: PosedField,
    rays: Rays,
    pose_batch: PoseBatch | None,
    points_m: Float[Tensor, "p 3"],
    step_m: float,
    max_samples: int,
    feature_gradients: FeatureGradients,
) -> RenderOutput:
    """`render_rays` for any field, inverse skinning and device; evaluates all samples, also those behind a surface."""
    field, inverse, occupancy = posed_field.field, posed_field.inverse, posed_field.occupancy
    samples = inverse.sample_rays(rays, step_m, occupancy, max_samples)
    count = len(samples.distance_m)
    sample_positions_m = sample_positions(inverse, rays, pose_batch, samples) if pose_batch else samples.canonical_m
    colour, density = field.radiance(torch.cat([sample_positions_m, points_m]), feature_gradients)
    step = torch.full_like(samples.distance_m, step_m)
    image, alpha, weight = composite(density[:count], colour[:count], step, samples.ray_offsets)
    transmittance = transmittance_from_weights(weight, samples.ray_offsets)
    return RenderOutput(image, alpha, density[count:], samples.canonical_m, transmittance, weight.detach())


def sample_positions(
    inverse: InverseSkinning, rays: Rays, pose_batch: PoseBatch, samples: Samples
) -> Float[Tensor, "s 3"]:
    """Return the canonical positions (m) of samples in the present poses, differentiable in the poses."""
    ray = segment_ids_from_counts(samples.ray_offsets.diff())
    # index_select takes a third of the time of plain indexing for tensors of this size.
    offset = samples.distance_m[:, None] * rays.directions.index_select(0, ray)
    posed = rays.origins_m.index_select(0, ray) + offset
    skin, frames, matrices = pose_batch
    slots = torch.arange(len(frames) + 1, device=frames.device)
    frame_offsets = samples.ray_offsets[torch.searchsorted(pose_batch.frame_slots(rays), slots)]
    return inverse.to_canonical(skin, matrices, frames, samples.canonical_m, posed, frame_offsets)
