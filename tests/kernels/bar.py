"""Test body: a bar along x with two bones, which bends in the middle."""

import numpy as np
import torch

from pipeline.kernels.inverse_skinning import SkinGrid

CELL_M = 0.05


def bar_skin(half_length_m=0.6, half_width_m=0.15) -> SkinGrid:
    """Skin grid of the bar; the weight of the second bone rises smoothly from x = -0.15 m to 0.15 m."""
    axes = [np.arange(-half, half + 1e-6, CELL_M) for half in (half_length_m, half_width_m, half_width_m)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).astype(np.float32)
    shape = nodes.shape[:3]
    nodes = nodes.reshape(-1, 3)
    second = 1 / (1 + np.exp(-nodes[:, 0] / 0.04))
    weights = torch.from_numpy(np.stack([1 - second, second], axis=-1).astype(np.float32))
    distance = np.abs(nodes[:, 1:]).max(1) - 0.1
    rows = torch.arange(len(nodes), dtype=torch.int32).view(shape)
    nodes_m, distance_m = torch.from_numpy(nodes), torch.from_numpy(distance.astype(np.float32))
    return SkinGrid(nodes_m.amin(0), CELL_M, rows, nodes_m, distance_m, weights)


def bend(angle_rad: float, dtype=torch.float32) -> torch.Tensor:
    """Skinning matrices (2, 4, 4): the second bone rotates about z at the origin."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    rotation = torch.eye(4, dtype=dtype)
    rotation[:2, :2] = torch.tensor([[c, -s], [s, c]], dtype=dtype)
    return torch.stack([torch.eye(4, dtype=dtype), rotation])


def bar_points(count: int, seed: int = 0) -> torch.Tensor:
    """Random canonical points inside the bar."""
    random = torch.Generator().manual_seed(seed)
    return (2 * torch.rand(count, 3, generator=random) - 1) * torch.tensor([0.5, 0.09, 0.09])
