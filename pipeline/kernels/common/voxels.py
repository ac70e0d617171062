"""Values of a grid of voxels that fills the unit box, at points of the box."""

import torch
from jaxtyping import Float, Int
from torch import Tensor


def voxel_index(unit: Float[Tensor, "n 3"], shape: tuple[int, ...]) -> Int[Tensor, "n"]:
    """Return the flat index (x slowest) of the voxel of each point of the unit box; points outside take the nearest.

    >>> voxel_index(torch.tensor([[0.0, 0.6, 2.0]]), (4, 2, 2)).tolist()
    [3]
    """
    size = torch.tensor(shape, device=unit.device)
    cell = torch.minimum((unit.detach() * size).long().clamp(min=0), size - 1)
    return (cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2]


def voxel_values(unit: Float[Tensor, "n 3"], grid: Float[Tensor, "gx gy gz"]) -> Float[Tensor, "n"]:
    """Return the value of the voxel of each point of the unit box; differentiable in the grid."""
    return grid.reshape(-1).index_select(0, voxel_index(unit, tuple(grid.shape)))
