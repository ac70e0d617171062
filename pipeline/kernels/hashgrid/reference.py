"""Plain-torch reference of the hash grid: any dtype, any device, gradients by autograd."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.kernels.common.grid_corners import cell_corners
from pipeline.kernels.common.hashing import PRIMES

LOW_32 = 0xFFFFFFFF


def encode(
    points_unit: Float[Tensor, "n 3"], table: Float[Tensor, "rows f"], level_params: np.ndarray
) -> Float[Tensor, "n width"]:
    """Do `pipeline.kernels.hashgrid.encode`, all levels at once; `level_params` is `GridLayout.level_params`."""
    levels = torch.from_numpy(level_params).to(table.device)
    cells, (first, rows, dense) = levels[:, :3], levels[:, 3:, None].unbind(1)
    corner, axis_weights = cell_corners(points_unit.clamp(0, 1)[:, None] * cells, cells)
    x, y, z = corner.unbind(-1)
    in_grid = x + (cells[:, :1] + 1) * (y + (cells[:, 1:2] + 1) * z)
    hashed = (x ^ (y * PRIMES[0] & LOW_32) ^ (z * PRIMES[1] & LOW_32)) & (rows - 1)
    row = first + torch.where(dense == 1, in_grid, hashed)
    features = table.index_select(0, row.view(-1)).view(*row.shape, -1)
    return (axis_weights.prod(-1, keepdim=True) * features).sum(2).flatten(1)
