"""Plain-torch twin of the hash grid: any dtype, any device, gradients by autograd."""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.kernels.hashing import PRIMES


def _rows(corner: Int[Tensor, "n 3"], cells: tuple[int, int, int], rows: int, dense: bool) -> Int[Tensor, "n"]:
    x, y, z = corner.unbind(-1)
    if dense:
        return x + (cells[0] + 1) * (y + (cells[1] + 1) * z)
    low32 = 0xFFFFFFFF
    return (x ^ (y * PRIMES[0] & low32) ^ (z * PRIMES[1] & low32)) & (rows - 1)


def encode(
    points_unit: Float[Tensor, "n 3"], table: Float[Tensor, "rows f"], plan: np.ndarray
) -> Float[Tensor, "n width"]:
    """Same as `pipeline.kernels.hashgrid.encode`; `plan` is `GridLayout.plan`."""
    points_unit = points_unit.clamp(0, 1)
    levels = []
    for *cells, first, rows, dense in plan.tolist():
        limit = torch.tensor(cells, device=table.device)
        scaled = points_unit * limit
        low = torch.minimum(scaled.detach().long(), limit - 1)
        part = scaled - low
        total = table.new_zeros(len(points_unit), table.shape[1])
        for corner in range(8):
            bits = torch.tensor([corner & 1, corner >> 1 & 1, corner >> 2 & 1], device=table.device)
            weight = torch.where(bits == 1, part, 1 - part).prod(-1, keepdim=True)
            total = total + weight * table[first + _rows(low + bits, cells, rows, bool(dense))]
        levels.append(total)
    return torch.cat(levels, -1)
