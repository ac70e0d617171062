"""Plain-torch reference of the fused renderer: the composition of its kernels; any device, all samples at once."""

import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.kernels.common.packing import segment_ids_from_counts
from pipeline.kernels.common.voxels import voxel_values
from pipeline.kernels.composite import composite
from pipeline.kernels.hashgrid import encode
from pipeline.kernels.inverse_skinning import newton_step
from pipeline.kernels.march import Rays, Samples, SamplingVolume, march
from pipeline.kernels.transmittance_stats import transmittance_from_weights
from pipeline.kernels.volume_rendering.inputs import BatchSkinning, RadianceNetwork, RenderOutput, RenderSettings


def render_rays(
    rays: Rays,
    volume: SamplingVolume,
    network: RadianceNetwork,
    skinning: BatchSkinning | None,
    points_m: Float[Tensor, "p 3"],
    settings: RenderSettings,
) -> RenderOutput:
    """Do `pipeline.kernels.volume_rendering.render_rays_fused` without approximations; samples are in ray order.

    Autograd also returns the gradient of the hash table.
    """
    samples = march(rays, volume, settings.step_m, settings.max_samples)
    count = len(samples.distance_m)
    positions_m = _refine(rays, samples, skinning) if skinning else samples.canonical_m
    colour, density = _evaluate(network, torch.cat([positions_m, points_m]))
    step = torch.full_like(samples.distance_m, settings.step_m)
    image, alpha, weight = composite(density[:count], colour[:count], step, samples.ray_offsets)
    transmittance = transmittance_from_weights(weight, samples.ray_offsets)
    return RenderOutput(image, alpha, density[count:], samples.canonical_m, transmittance, weight)


def _refine(rays: Rays, samples: Samples, skinning: BatchSkinning) -> Float[Tensor, "s 3"]:
    """Do one Newton step for each sample."""
    ray = segment_ids_from_counts(samples.ray_offsets.diff())
    posed_m = rays.origins_m[ray] + samples.distance_m[:, None] * rays.directions[ray]
    slots = torch.arange(len(skinning.canonical_to_posed) + 1)
    frame_offsets = samples.ray_offsets[torch.searchsorted(skinning.batch_index, slots)]
    blended = skinning.skin.blend(skinning.canonical_to_posed)
    return newton_step(blended, samples.canonical_m, posed_m, frame_offsets, skinning.skin)


def _evaluate(
    network: RadianceNetwork, points_m: Float[Tensor, "p 3"]
) -> tuple[Float[Tensor, "p 3"], Float[Tensor, "p"]]:
    """Return colour and density (1/m) at canonical points."""
    low_m, high_m = network.bounds_m
    features = encode((points_m - low_m) / (high_m - low_m), network.table, network.layout)
    raw = torch.relu(features @ network.hidden) @ network.output + network.bias
    # Truncated exponential of Instant-NGP: the exponent is clamped, its gradient is not.
    clamped = raw[:, 3].clamp(-network.exponent_limit, network.exponent_limit)
    exponent = raw[:, 3] + (clamped - raw[:, 3]).detach()
    density = network.initial_density_per_m * exponent.exp()
    gate = 1.0 if network.gate is None else voxel_values((points_m - low_m) / (high_m - low_m), network.gate)
    return torch.sigmoid(raw[:, :3]), density * gate
