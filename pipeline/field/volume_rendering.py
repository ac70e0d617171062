"""What rays see of the canonical field, wherever the poses carry it; differentiable in field and poses.

Letters: n rays, b frames of a batch, j joints, p points.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.field.field import LIMIT, START_DENSITY_PER_M, Field
from pipeline.field.inverse_skinning import Inverse, Rays
from pipeline.field.occupancy import Occupancy
from pipeline.kernels.common.dispatch import runs_on_numba
from pipeline.kernels.common.packing import owner_of_each
from pipeline.kernels.composite import composite
from pipeline.kernels.hashgrid import Towards
from pipeline.kernels.inverse_skinning import SkinGrid
from pipeline.kernels.march import Samples
from pipeline.kernels.transmittance_stats import light_before
from pipeline.kernels.volume_rendering import Radiance, Skinning, Space, Traced, trace


class Placing(NamedTuple):
    """Where samples are carried: skin weights, and the skinning matrices of the batch's frames, which are in order."""

    skin: SkinGrid
    frames: Int[Tensor, "b"]
    canonical_to_posed: Float[Tensor, "b j 4 4"]

    def blended(self) -> Float[Tensor, "m b 12"]:
        """The matrices at the nodes of the skin grid."""
        return self.skin.blend(self.canonical_to_posed)

    def slot_of(self, rays: Rays) -> Int[Tensor, "n"]:
        """Which of the frames each ray belongs to."""
        return torch.searchsorted(self.frames, rays.frame)


def ends_with_the_light(field: Field, inverse: Inverse) -> bool:
    """Whether `look` asks only for what light reaches: a hash grid behind warp grids, on the CPU."""
    return inverse.warps is not None and field.trunk is None and runs_on_numba(field.table)


def look(
    field: Field,
    inverse: Inverse,
    occupancy: Occupancy,
    rays: Rays,
    placing: Placing | None,
    points_m: Float[Tensor, "p 3"],
    step_m: float,
    max_samples: int,
    towards: Towards,
) -> Traced:
    """Colour and alpha of rays, density of some more points, and what the samples saw.

    rays: their frames are rows of the motion that `inverse` undoes, in order.
    placing: None: samples lie where `inverse` found them.
    towards: takes what the hash table's gradient is made of (`pipeline.kernels.hashgrid.encode`).
    """
    warps = inverse.warps
    if warps is None or not ends_with_the_light(field, inverse):
        return look_at_all(field, inverse, occupancy, rays, placing, points_m, step_m, max_samples, towards)
    network = (field.hidden, field.output, field.bias)
    return trace(
        *rays,
        Space(warps, occupancy.occupied, occupancy.bounds_m),
        Radiance(field.bounds_m, field.table, field.layout, *network, START_DENSITY_PER_M, LIMIT),
        Skinning(placing.skin, placing.blended(), placing.slot_of(rays)) if placing else None,
        points_m,
        step_m,
        max_samples,
        towards,
    )


def look_at_all(
    field: Field,
    inverse: Inverse,
    occupancy: Occupancy,
    rays: Rays,
    placing: Placing | None,
    points_m: Float[Tensor, "p 3"],
    step_m: float,
    max_samples: int,
    towards: Towards,
) -> Traced:
    """`look` with any inverse, field and device: all samples at once, those behind a surface too."""
    samples = inverse.sample(rays, step_m, occupancy, max_samples)
    count = len(samples.distance_m)
    places = _place(inverse, rays, placing, samples) if placing else samples.canonical_m
    colour, density = field.radiance(torch.cat([places, points_m]), towards)
    step = torch.full_like(samples.distance_m, step_m)
    image, alpha, weight = composite(density[:count], colour[:count], step, samples.ray_start)
    light = light_before(weight, samples.ray_start)
    return Traced(image, alpha, density[count:], samples.canonical_m, light, weight.detach())


def _place(inverse: Inverse, rays: Rays, placing: Placing, samples: Samples) -> Float[Tensor, "s 3"]:
    """Where the poses carry samples, differentiably."""
    ray = owner_of_each(samples.ray_start.diff())
    # Rows by index_select: plain indexing takes three times as long for tensors of this size.
    offset = samples.distance_m[:, None] * rays.directions.index_select(0, ray)
    posed = rays.origins_m.index_select(0, ray) + offset
    skin, frames, matrices = placing
    slots = torch.arange(len(frames) + 1, device=frames.device)
    slot_start = samples.ray_start[torch.searchsorted(placing.slot_of(rays), slots)]
    return inverse.place(skin, matrices, frames, samples.canonical_m, posed, slot_start)
