"""Corners of grid cells and trilinear weights, on any device."""

from functools import cache

import torch
from jaxtyping import Float, Int
from torch import Tensor


@cache
def corner_offsets(device: torch.device) -> Int[Tensor, "8 3"]:
    """Return the offsets (0 or 1 along x, y, z) of the eight corners of a cell; x changes fastest."""
    return torch.arange(8, device=device)[:, None] >> torch.arange(3, device=device) & 1


def cell_corners(
    scaled: Float[Tensor, "*n 3"], cells: Int[Tensor, "*m 3"], clamp: bool = False
) -> tuple[Int[Tensor, "*n 8 3"], Float[Tensor, "*n 8 3"]]:
    """Return the corners of the cell that contains each point, and their linear weights along each axis.

    The product of the three axis weights is the trilinear weight of a corner. The weights are differentiable.

    Args:
        scaled: positions in units of cells, relative to the first corner of the grid.
        cells: number of cells along each axis, broadcast to the points. Points outside use the nearest cell of the
            border, and their weights extrapolate linearly.
        clamp: clamp the weights to [0, 1] instead of extrapolating.
    """
    low = torch.minimum(scaled.detach().floor().long().clamp(min=0), cells - 1)
    part = (scaled - low).clamp(0, 1) if clamp else scaled - low
    bits = corner_offsets(scaled.device)
    return low[..., None, :] + bits, torch.where(bits == 1, part[..., None, :], 1 - part[..., None, :])
