"""Plain-torch reference of ray marching through warp grids: any dtype, any device."""

from functools import partial

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.kernels.common.grid_corners import cell_corners
from pipeline.kernels.march.inputs import PackedWarpGrids, Rays, SamplingVolume
from pipeline.kernels.march.reference_stops import march_with_inverse

CANDIDATES = 4


def _query_warp_grids(posed: Tensor, frame: Tensor, warps: PackedWarpGrids) -> tuple[Tensor, Tensor]:
    """Return the canonical candidates (p, 4, 3) of posed points (p, 3), and which of the four exist."""
    nodes, cell_codes, affine_maps = warps.canonical_m, warps.cell_codes, warps.affine_maps
    dims, first = warps.dims[frame], warps.offsets[frame]
    scaled = (posed - warps.origin_m[frame].to(posed)) / warps.cell_m
    low = torch.minimum(scaled.long().clamp(min=0), dims - 2)
    i, j, k = low.unbind(-1)
    cell_index = first[:, 1] + (i * (dims[:, 1] - 1) + j) * (dims[:, 2] - 1) + k
    code = cell_codes[cell_index.clamp(max=len(cell_codes) - 1)].long()
    corner, axis_weights = cell_corners(scaled, dims - 1)
    i, j, k = corner.unbind(-1)
    node = first[:, :1] + (i * dims[:, 1:2] + j) * dims[:, 2:] + k
    # Missing nodes are NaN; the code of a cell with such a corner is not 0.
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
    rays: Rays, volume: SamplingVolume, step_m: float, max_samples: int
) -> tuple[Float[Tensor, "s 3"], Float[Tensor, "s"], Int[Tensor, "m"]]:
    """Do `pipeline.kernels.march.march`; return the fields of `Samples`."""
    warps = volume.warps
    low = warps.origin_m.to(rays.origins_m)
    boxes = torch.stack([low, low + warps.cell_m * (warps.dims - 1)], dim=1)
    find_inverses = partial(_query_warp_grids, warps=warps)
    return march_with_inverse(find_inverses, rays, step_m, boxes, volume.occupied, volume.bounds_m, max_samples)
