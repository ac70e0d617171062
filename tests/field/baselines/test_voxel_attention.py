"""Voxel attention: what it learns from the rays, and its initial weights."""

import numpy as np
import torch

from pipeline.field.baselines.voxel_attention import VoxelAttention
from tests.field.occupancy_ball import STEP_M, ball_density, ball_grid, record_rays


def test_attention_learns_from_the_rays_which_cells_are_occupied():
    grid, rng = ball_grid(True), np.random.default_rng(0)
    for _ in range(120):
        record_rays(grid, rng)
        grid.update(ball_density, STEP_M, rng)
    density, distance = torch.tensor([200.0, 0.0]), torch.tensor([-0.02, 0.15])
    weight = torch.sigmoid(grid.attention(density, distance, torch.tensor([0.9, 0.6])))
    assert float(weight[0]) > 0.7
    assert float(weight[1]) < 0.3


def test_weights_are_high_before_training():
    weight = torch.sigmoid(VoxelAttention(0.1, 0)(torch.rand(50) * 100, torch.rand(50) * 0.1, torch.rand(50)))
    assert float(weight.min()) > 0.5
