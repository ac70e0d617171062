"""Ray marching with any way back to canonical space: plain torch, all stops of all rays at once."""

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from pipeline.kernels.common.packing import owner_of_each

Find = Callable[
    [Float[Tensor, "p 3"], Int[Tensor, "p"]],
    tuple[Float[Tensor, "p c 3"], Bool[Tensor, "p c"]],
]
"""Posed points (m) and their frames -> canonical candidates (m), and which of them exist."""


def march_with(
    find: Find,
    origins_m: Float[Tensor, "n 3"],
    directions: Float[Tensor, "n 3"],
    frame: Int[Tensor, "n"],
    jitter: Float[Tensor, "n"],
    step_m: float,
    boxes_m: Float[Tensor, "k 2 3"],
    occupied: UInt8[Tensor, "gx gy gz"],
    bounds_m: Float[Tensor, "2 3"],
    max_samples: int,
) -> tuple[Float[Tensor, "s 3"], Float[Tensor, "s"], Int[Tensor, "m"]]:
    """Canonical points, distances along the rays and ray starts, as `pipeline.kernels.march.march` has them.

    boxes_m: the posed box (low and high corner) in which the rays of each frame make their stops.
    """
    near, far = _near_far(origins_m, directions, boxes_m[frame])
    count = ((far - near) / step_m - jitter).ceil().clamp(min=0).long()
    ray = owner_of_each(count)
    stop = torch.arange(len(ray), device=count.device) - (count.cumsum(0) - count)[ray]
    distance = near[ray] + (stop + jitter[ray]) * step_m
    points, exists = find(origins_m[ray] + distance[:, None] * directions[ray], frame[ray])
    size = torch.tensor(occupied.shape, device=points.device)
    index = ((points - bounds_m[0]) * (size / (bounds_m[1] - bounds_m[0]))).floor()
    inside = exists & (index >= 0).all(-1) & (index < size).all(-1)
    index = torch.where(inside[..., None], index, 0).long()
    kept = inside & (occupied[tuple(index.unbind(-1))] != 0)
    stop, candidate = torch.nonzero(kept, as_tuple=True)
    per_ray = torch.bincount(ray[stop], minlength=len(count))
    rank = torch.arange(len(stop), device=count.device) - (per_ray.cumsum(0) - per_ray)[ray[stop]]
    stop, candidate = stop[rank < max_samples], candidate[rank < max_samples]
    ray_start = torch.cat([per_ray.new_zeros(1), per_ray.clamp(max=max_samples).cumsum(0)])
    return points[stop, candidate], distance[stop], ray_start


def _near_far(origins: Tensor, directions: Tensor, boxes: Tensor) -> tuple[Tensor, Tensor]:
    """Distances at which each ray enters and leaves its box."""
    safe = torch.where(directions.abs() < 1e-9, torch.full_like(directions, 1e-9), directions)
    a, b = (boxes[:, 0] - origins) / safe, (boxes[:, 1] - origins) / safe
    return torch.minimum(a, b).amax(-1).clamp(min=0), torch.maximum(a, b).amin(-1)
