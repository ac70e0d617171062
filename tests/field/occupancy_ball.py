"""A ball-shaped body in an occupancy grid, for tests of the update rules."""

import numpy as np
import torch

from pipeline.field.baselines.voxel_attention import AttentionOccupancyGrid
from pipeline.field.occupancy import RESOLUTION, CellData, OccupancyGrid, cell_centres

BOUNDS = np.array([[-1.0, -1, -1], [1, 1, 1]], dtype=np.float32)
STEP_M = 0.02
RADIUS_M = 0.5
CLOTHING_OFFSET_M = 0.3


def ball_grid(attention: bool) -> OccupancyGrid:
    """Candidate cells within 0.8 m of the origin; the body is a ball of 0.5 m, one-sided where y > 0.5 m."""
    centres = cell_centres(BOUNDS)
    distance_m = (np.linalg.norm(centres, axis=1) - RADIUS_M).reshape((RESOLUTION,) * 3).astype(np.float32)
    mask_fraction = np.clip(0.9 - 2 * distance_m, 0, 1).astype(np.float32)
    one_sided = (centres[:, 1] > RADIUS_M).reshape(distance_m.shape)
    cells = CellData(distance_m < CLOTHING_OFFSET_M, distance_m, mask_fraction, one_sided, BOUNDS)
    if attention:
        return AttentionOccupancyGrid(cells, 0.9, 0.01, CLOTHING_OFFSET_M, seed=0)
    return OccupancyGrid(cells, 0.9, 0.01)


def ball_density(points: torch.Tensor) -> torch.Tensor:
    """Density of the ball, 1/m."""
    return 200.0 * (points.norm(dim=1) < RADIUS_M)


def record_rays(grid: OccupancyGrid, rng: np.random.Generator) -> None:
    """Record rays from all sides, which reach all cells outside the ball and the first ones inside."""
    points = torch.from_numpy(rng.uniform(-0.9, 0.9, (40_000, 3)).astype(np.float32))
    depth_m = RADIUS_M - points.norm(dim=1)
    transmittance = (1 - depth_m / 0.05).clamp(0, 1)
    grid.record_observations(points, transmittance, transmittance * (depth_m > 0))
