"""The occupancy grid: its updates, its classes of cells, and its state."""

import numpy as np
import pytest
import torch

from pipeline.field.initial_occupancy import initial_occupancy
from pipeline.field.occupancy import RESOLUTION, BinaryOccupancy, cell_centres
from tests.field.occupancy_ball import BOUNDS, RADIUS_M, STEP_M, ball_density, ball_grid, record_rays


@pytest.mark.parametrize("attention", [False, True])
def test_cells_without_density_become_empty(attention):
    grid, rng = ball_grid(attention), np.random.default_rng(0)
    start = int(grid.occupied.sum())
    for _ in range(40):
        record_rays(grid, rng)
        grid.update(ball_density, STEP_M, rng)
    centres = torch.from_numpy(cell_centres(BOUNDS))
    occupied = grid.occupied.view(-1) != 0
    inside, outside = centres.norm(dim=1) < 0.45, centres.norm(dim=1) > 0.56
    assert occupied[inside].all()
    assert not occupied[outside].any()
    assert int(occupied.sum()) < 0.5 * start


def test_cells_that_are_not_candidates_stay_empty():
    grid = ball_grid(False)
    grid.update(lambda points: torch.full((len(points),), 1e3), STEP_M, np.random.default_rng(0))
    assert int(grid.occupied.sum()) == len(grid.candidate_cells)


@pytest.mark.parametrize("attention", [False, True])
def test_a_restored_grid_continues_bit_for_bit(attention):
    whole, resumed = ball_grid(attention), ball_grid(attention)
    for seed in range(6):
        if seed == 3:
            state = {name: value.clone() for name, value in resumed.state_dict().items()}
            resumed = ball_grid(attention)
            resumed.load_state_dict(state)
        for grid in (whole, resumed):
            rng = np.random.default_rng(seed)
            record_rays(grid, rng)
            grid.update(ball_density, STEP_M, rng)
    for name, value in whole.state_dict().items():
        assert torch.equal(value, resumed.state_dict()[name]), name


def test_initial_occupancy_needs_masks_outside_the_body_only():
    distance = np.array([-0.1, 0.05, 0.05, 0.2])
    mask_fraction = np.array([0.0, 0.9, 0.3, 1.0])
    assert initial_occupancy(distance, mask_fraction, 0.1, 0.6).tolist() == [True, True, False, False]


def test_unobserved_cells_are_unlit_or_one_sided_and_off_the_body():
    grid, rng = ball_grid(False), np.random.default_rng(0)
    centres = torch.from_numpy(cell_centres(BOUNDS))
    radius = centres.norm(dim=1)
    left, above = centres[:, 0] < 0, centres[:, 1] > RADIUS_M
    points = centres[left & (radius < 0.8)]
    grid.record_observations(points, torch.ones(len(points)), torch.zeros(len(points)))
    assert len(grid.unobserved) == 0
    grid.update(lambda points: torch.full((len(points),), 50.0), 0.01, rng)
    unobserved = torch.zeros(len(centres), dtype=torch.bool)
    unobserved[grid.unobserved] = True
    assert unobserved[(~left | above) & (radius > 0.54) & (radius < 0.78)].all()
    assert unobserved[above & (radius > 0.52) & (radius < 0.78)].all()
    assert not unobserved[(left & ~above) | (~above & (radius < 0.53)) | (radius < 0.51) | (radius > 0.8)].any()
    cells = grid.unobserved[:500]
    inside = (grid.sample_in_cells(cells, rng) - centres[cells]).abs() * RESOLUTION / 2
    assert 0.45 < float(inside.max()) <= 0.5 + 1e-5
    points = grid.sample_empty_points(0, 300, rng)
    cell = ((points + 1) * RESOLUTION / 2).floor().long()
    assert len(points) == 300
    assert unobserved[(cell * torch.tensor([RESOLUTION**2, RESOLUTION, 1])).sum(1)].all()
    # Cells that became empty are no longer unobserved.
    for _ in range(60):
        grid.update(lambda points: torch.zeros(len(points)), 0.01, rng)
    assert len(grid.unobserved) == 0


def test_the_occupied_bounds_are_the_corners_of_the_outermost_occupied_cells() -> None:
    occupied = torch.zeros(8, 4, 2, dtype=torch.uint8)
    bounds_m = torch.tensor([[-1.0, 0.0, 2.0], [1.0, 2.0, 3.0]])
    np.testing.assert_allclose(BinaryOccupancy(occupied, bounds_m).occupied_bounds_m(), bounds_m)
    occupied[2, 1, 0] = occupied[5, 1, 0] = 1
    np.testing.assert_allclose(
        BinaryOccupancy(occupied, bounds_m).occupied_bounds_m(), [[-0.5, 0.5, 2.0], [0.5, 1.0, 2.5]]
    )
