"""Plain-torch twin of ray marching through warp grids: any dtype, any device."""

from functools import partial

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from pipeline.kernels.reference.stops import march_with


def _look_up(posed: Tensor, frame: Tensor, warp: tuple) -> tuple[Tensor, Tensor]:
    """Canonical candidates (p, 4, 3) of posed points (p, 3), and which of the four exist."""
    cell, origin, dims, first, nodes, codes, maps = warp
    dims, first = dims[frame], first[frame]
    scaled = (posed - origin[frame]) / cell
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
    points = torch.zeros(len(posed), 4, 3, dtype=posed.dtype, device=posed.device)
    exists = torch.zeros(points.shape[:2], dtype=torch.bool, device=posed.device)
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
    low = origin.to(origins_m)
    boxes = torch.stack([low, low + float(cell) * (dims - 1)], dim=1)
    find = partial(_look_up, warp=warp)
    return march_with(find, origins_m, directions, frame, jitter, step_m, boxes, occupied, bounds_m, max_samples)
