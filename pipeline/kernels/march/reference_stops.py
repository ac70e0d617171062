"""Ray marching with any inverse skinning: plain torch, all steps of all rays at once."""

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from pipeline.kernels.common.packing import segment_ids_from_counts
from pipeline.kernels.march.inputs import Rays

FindInverses = Callable[
    [Float[Tensor, "p 3"], Int[Tensor, "p"]],
    tuple[Float[Tensor, "p c 3"], Bool[Tensor, "p c"]],
]
"""Maps posed points (m) and their frames to canonical candidates (m), and to which of the candidates exist."""


def march_with_inverse(
    find_inverses: FindInverses,
    rays: Rays,
    step_m: float,
    boxes_m: Float[Tensor, "k 2 3"],
    occupied: UInt8[Tensor, "gx gy gz"],
    bounds_m: Float[Tensor, "2 3"],
    max_samples: int,
) -> tuple[Float[Tensor, "s 3"], Float[Tensor, "s"], Int[Tensor, "m"]]:
    """Sample rays in occupied cells; return the fields of `pipeline.kernels.march.Samples`.

    boxes_m: posed bounding box (low and high corner) of each frame; the steps of a ray are inside it.
    occupied, bounds_m, max_samples: see `pipeline.kernels.march`.
    """
    origins_m, directions, frame, jitter = rays
    near, far = _near_far(origins_m, directions, boxes_m[frame])
    count = ((far - near) / step_m - jitter).ceil().clamp(min=0).long()
    ray = segment_ids_from_counts(count)
    step_index = torch.arange(len(ray), device=count.device) - (count.cumsum(0) - count)[ray]
    distance = near[ray] + (step_index + jitter[ray]) * step_m
    points, exists = find_inverses(origins_m[ray] + distance[:, None] * directions[ray], frame[ray])
    size = torch.tensor(occupied.shape, device=points.device)
    index = ((points - bounds_m[0]) * (size / (bounds_m[1] - bounds_m[0]))).floor()
    inside = exists & (index >= 0).all(-1) & (index < size).all(-1)
    index = torch.where(inside[..., None], index, 0).long()
    kept = inside & (occupied[tuple(index.unbind(-1))] != 0)
    step_index, candidate = torch.nonzero(kept, as_tuple=True)
    per_ray = torch.bincount(ray[step_index], minlength=len(count))
    rank = torch.arange(len(step_index), device=count.device) - (per_ray.cumsum(0) - per_ray)[ray[step_index]]
    step_index, candidate = step_index[rank < max_samples], candidate[rank < max_samples]
    ray_offsets = torch.cat([per_ray.new_zeros(1), per_ray.clamp(max=max_samples).cumsum(0)])
    return points[step_index, candidate], distance[step_index], ray_offsets


def _near_far(origins: Tensor, directions: Tensor, boxes: Tensor) -> tuple[Tensor, Tensor]:
    """Return the distances at which each ray enters and leaves its box."""
    safe = torch.where(directions.abs() < 1e-9, torch.full_like(directions, 1e-9), directions)
    a, b = (boxes[:, 0] - origins) / safe, (boxes[:, 1] - origins) / safe
    return torch.minimum(a, b).amax(-1).clamp(min=0), torch.maximum(a, b).amin(-1)
