"""Plain-torch twin of ray marching through warp grids: any dtype, any device."""

from functools import partial

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from pipeline.kernels.common.grid_corners import cell_corners
from pipeline.kernels.march.reference_stops import march_with_inverse

CANDIDATES = 4


def _query_warp_grids(posed: Tensor, frame: Tensor, cell_m: float, warp: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
    """Canonical candidates (p, 4, 3) of posed points (p, 3), and which of the four exist."""
    origin, dims, first, nodes, cell_codes, affine_maps = warp
    dims, first = dims[frame], first[frame]
    scaled = (posed - origin[frame].to(posed)) / cell_m
    low = torch.minimum(scaled.long().clamp(min=0), dims - 2)
    i, j, k = low.unbind(-1)
    cell_index = first[:, 1] + (i * (dims[:, 1] - 1) + j) * (dims[:, 2] - 1) + k
    code = cell_codes[cell_index.clamp(max=len(cell_codes) - 1)].long()
    corner, axis_weights = cell_corners(scaled, dims - 1)
    i, j, k = corner.unbind(-1)
    node = first[:, :1] + (i * dims[:, 1:2] + j) * dims[:, 2:] + k
    # A node that does not exist is NaN; cells with such a corner have other codes.
    around = nodes[node.clamp(max=len(nodes) - 1)].to(posed)
    smooth = (axis_weights.prod(-1, keepdim=True) * around).sum(1)
    points = torch.zeros(len(posed), CANDIDATES, 3, dtype=posed.dtype, device=posed.device)
    candidate = torch.arange(CANDIDATES, device=posed.device)
    exists = (code[:, None] > 0) & ((code[:, None] - 1) % CANDIDATES >= candidate)
    if len(affine_maps):
        row = first[:, 2:] + (code[:, None].clamp(min=1) - 1) // CANDIDATES + candidate
        matrix = affine_maps[row.clamp(max=len(affine_maps) - 1)].view(-1, CANDIDATES, 3, 4).to(posed)
        points = (matrix[..., :3] * posed[:, None, None]).sum(-1) + matrix[..., 3]
    is_smooth = (code == 0)[:, None]
    points[:, 0] = torch.where(is_smooth, smooth, points[:, 0])
    return points, exists | (is_smooth & (candidate == 0))


def march(
    origins_m: Float[Tensor, "n 3"],
    directions: Float[Tensor, "n 3"],
    frame: Int[Tensor, "n"],
    jitter: Float[Tensor, "n"],
    step_m: float,
    cell_m: float,
    warp: tuple[Tensor, ...],
    occupied: UInt8[Tensor, "gx gy gz"],
    bounds_m: Float[Tensor, "2 3"],
    max_samples: int,
) -> tuple[Float[Tensor, "s 3"], Float[Tensor, "s"], Int[Tensor, "m"]]:
    """Same as `pipeline.kernels.march.march`; `warp` is `PackedWarpGrids.tensors()`, with cells of `cell_m`."""
    low = warp[0].to(origins_m)
    boxes = torch.stack([low, low + cell_m * (warp[1] - 1)], dim=1)
    find_inverses = partial(_query_warp_grids, cell_m=cell_m, warp=warp)
    return march_with_inverse(
        find_inverses, origins_m, directions, frame, jitter, step_m, boxes, occupied, bounds_m, max_samples
    )
