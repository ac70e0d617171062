"""Plain-torch twin of ray marching: every stop of every ray at once, any dtype, any device."""

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor


def _near_far(origins: Tensor, directions: Tensor, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    safe = torch.where(directions.abs() < 1e-9, torch.full_like(directions, 1e-9), directions)
    a, b = (low - origins) / safe, (high - origins) / safe
    near = torch.minimum(a, b).amax(-1).clamp(min=0)
    return near, torch.maximum(a, b).amin(-1)


def _look_up(posed: Tensor, frame: Tensor, warp: tuple) -> tuple[Tensor, Tensor]:
    """Canonical candidates (n, stops, 4, 3) of posed points (n, stops, 3), and which of the four exist."""
    cell, origin, dims, first, nodes, codes, maps = warp
    dims, first = dims[frame][:, None], first[frame][:, None]
    scaled = (posed - origin[frame][:, None]) / cell
    low = torch.minimum(scaled.long().clamp(min=0), dims - 2)
    i, j, k = low.unbind(-1)
    cell_index = first[..., 1] + (i * (dims[..., 1] - 1) + j) * (dims[..., 2] - 1) + k
    code = codes[cell_index.clamp(max=len(codes) - 1)]
    part, smooth = scaled - low, torch.zeros_like(posed)
    for corner in range(8):
        bits = torch.tensor([corner & 1, corner >> 1 & 1, corner >> 2 & 1], device=posed.device)
        at = low + bits
        node = first[..., 0] + (at[..., 0] * dims[..., 1] + at[..., 1]) * dims[..., 2] + at[..., 2]
        weight = torch.where(bits == 1, part, 1 - part).prod(-1)
        smooth = smooth + weight[..., None] * nodes[node.clamp(max=len(nodes) - 1)]
    points = torch.zeros(*posed.shape[:2], 4, 3, dtype=posed.dtype, device=posed.device)
    exists = torch.zeros(points.shape[:3], dtype=torch.bool, device=posed.device)
    for candidate in range(4):
        exists[..., candidate] = (code > 0) & ((code - 1) % 4 >= candidate)
        if len(maps):
            row = (first[..., 2] + (code.clamp(min=1) - 1) // 4 + candidate).clamp(max=len(maps) - 1)
            matrix = maps[row].view(*row.shape, 3, 4)
            points[..., candidate, :] = (matrix[..., :3] @ posed[..., None])[..., 0] + matrix[..., 3]
    points[..., 0, :] = torch.where((code == 0)[..., None], smooth, points[..., 0, :])
    exists[..., 0] |= code == 0
    return points, exists


def march(
    origins_m: Float[Tensor, "n 3"],
    directions: Float[Tensor, "n 3"],
    frame: Int[Tensor, "n"],
    jitter: Float[Tensor, "n"],
    step_m: float,
    warp_arrays: tuple,
    occupied: UInt8[Tensor, "gx gy gz"],
    bounds_m: Float[Tensor, "2 3"],
    max_samples: int,
) -> tuple[Float[Tensor, "s 3"], Float[Tensor, "s"], Int[Tensor, "m"]]:
    """Same as `pipeline.kernels.march.march`; `warp_arrays` is `WarpSet.arrays()`."""
    cell, *arrays = warp_arrays
    origin, dims, first, nodes, codes, maps = (torch.as_tensor(array, device=origins_m.device) for array in arrays)
    warp = (
        float(cell),
        origin.to(origins_m),
        dims.long(),
        first.long(),
        nodes.to(origins_m),
        codes.long(),
        maps.to(origins_m),
    )
    high = origin.to(origins_m) + float(cell) * (dims - 1)
    near, far = _near_far(origins_m, directions, origin.to(origins_m)[frame], high[frame])
    stop_count = ((far - near) / step_m - jitter).ceil().clamp(min=0).long()
    stops = torch.arange(max(1, int(stop_count.max())), device=origins_m.device)
    t = near[:, None] + (stops + jitter[:, None]) * step_m
    posed = origins_m[:, None] + t[..., None] * directions[:, None]
    points, exists = _look_up(posed, frame, warp)
    exists &= (stops < stop_count[:, None])[..., None]
    size = torch.tensor(occupied.shape, device=origins_m.device)
    index = ((points - bounds_m[0]) * (size / (bounds_m[1] - bounds_m[0]))).floor()
    inside = exists & (index >= 0).all(-1) & (index < size).all(-1)
    index = torch.where(inside[..., None], index, 0).long()
    kept = (inside & (occupied[tuple(index.unbind(-1))] != 0)).flatten(1)
    kept &= kept.cumsum(1) <= max_samples
    ray_start = torch.cat([kept.new_zeros(1, dtype=torch.long), kept.sum(1).cumsum(0)])
    distance = t[:, :, None].expand(exists.shape).flatten(1)[kept]
    return points.flatten(1, 2)[kept], distance, ray_start
