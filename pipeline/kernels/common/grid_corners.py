"""The eight corners around a point of a grid, and their shares in it, on any device."""

from functools import cache

import torch
from jaxtyping import Float, Int
from torch import Tensor


@cache
def corner_offsets(device: torch.device) -> Int[Tensor, "8 3"]:
    """0 or 1 along x, y and z for each corner; x changes fastest."""
    return torch.arange(8, device=device)[:, None] >> torch.arange(3, device=device) & 1


def cell_corners(
    scaled: Float[Tensor, "*n 3"], cells: Int[Tensor, "*m 3"], clamp: bool = False
) -> tuple[Int[Tensor, "*n 8 3"], Float[Tensor, "*n 8 3"]]:
    """Corners of the cell that holds each point, and the shares along each axis whose product is a corner's weight.

    scaled: in cells from the first corner. cells: number of cells along each axis, broadcast to the points; points
    beyond them take the last cell, and its weights go on linearly, or not if `clamp`. Shares are differentiable.
    """
    low = torch.minimum(scaled.detach().floor().long().clamp(min=0), cells - 1)
    part = (scaled - low).clamp(0, 1) if clamp else scaled - low
    bits = corner_offsets(scaled.device)
    return low[..., None, :] + bits, torch.where(bits == 1, part[..., None, :], 1 - part[..., None, :])
