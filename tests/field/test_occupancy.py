import numpy as np
import pytest
import torch

from pipeline.field.initial_occupancy import initial_occupancy
from pipeline.field.occupancy import RESOLUTION, OccupancyGrid, VoxelAttention, cell_centres

BOUNDS = np.array([[-1.0, -1, -1], [1, 1, 1]], dtype=np.float32)
STEP_M = 0.02
RADIUS_M = 0.5


def ball_grid(attention, rate=0.03):
    """Cells within 0.8 m of the origin may be occupied; the body is a ball of half a metre, filmed from one side above
    half a metre.
    """
    centres = cell_centres(BOUNDS)
    distance = (np.linalg.norm(centres, axis=1) - RADIUS_M).reshape((RESOLUTION,) * 3).astype(np.float32)
    mask_fraction = np.clip(0.9 - 2 * distance, 0, 1).astype(np.float32)
    one_sided = (centres[:, 1] > RADIUS_M).reshape(distance.shape)
    return OccupancyGrid(
        distance < 0.3, distance, mask_fraction, one_sided, BOUNDS, 0.3, attention, rate, 0.9, 0.01, seed=0
    )


def ball_density(points):
    return 200.0 * (points.norm(dim=1) < RADIUS_M)


def record_rays(update, random):
    """Rays from all sides: light reaches all cells outside the ball and the first ones inside."""
    points = torch.from_numpy(random.uniform(-0.9, 0.9, (40_000, 3)).astype(np.float32))
    depth = RADIUS_M - points.norm(dim=1)
    transmittance = (1 - depth / 0.05).clamp(0, 1)
    update.record_observations(points, transmittance, transmittance * (depth > 0))


@pytest.mark.parametrize("attention", [False, True])
def test_cells_without_density_are_emptied(attention):
    update, random = ball_grid(attention), np.random.default_rng(0)
    start = int(update.occupied.sum())
    for _ in range(40):
        record_rays(update, random)
        update.update(ball_density, STEP_M, random)
    centres = torch.from_numpy(cell_centres(BOUNDS))
    occupied = update.occupied.view(-1) != 0
    inside, outside = centres.norm(dim=1) < 0.45, centres.norm(dim=1) > 0.56
    assert occupied[inside].all()
    assert not occupied[outside].any()
    assert int(occupied.sum()) < 0.5 * start


def test_attention_learns_what_light_showed():
    update, random = ball_grid(True), np.random.default_rng(0)
    for _ in range(120):
        record_rays(update, random)
        update.update(ball_density, STEP_M, random)
    density, distance = torch.tensor([200.0, 0.0]), torch.tensor([-0.02, 0.15])
    weight = torch.sigmoid(update.attention(density, distance, torch.tensor([0.9, 0.6])))
    assert float(weight[0]) > 0.7
    assert float(weight[1]) < 0.3


def test_attention_trusts_the_density_before_it_has_learnt():
    weight = torch.sigmoid(VoxelAttention(0.1, 0)(torch.rand(50) * 100, torch.rand(50) * 0.1, torch.rand(50)))
    assert float(weight.min()) > 0.5


def test_cells_outside_the_shell_stay_empty():
    update = ball_grid(False)
    update.update(lambda points: torch.full((len(points),), 1e3), STEP_M, np.random.default_rng(0))
    assert int(update.occupied.sum()) == len(update.cells)


@pytest.mark.parametrize("attention", [False, True])
def test_goes_on_from_its_state_to_the_bit(attention):
    whole, broken = ball_grid(attention), ball_grid(attention)
    for seed in range(6):
        if seed == 3:
            kept = {name: value.clone() for name, value in broken.state().items()}
            broken = ball_grid(attention)
            broken.load_state(kept)
        for update in (whole, broken):
            random = np.random.default_rng(seed)
            record_rays(update, random)
            update.update(ball_density, STEP_M, random)
    for name, value in whole.state().items():
        assert torch.equal(value, broken.state()[name]), name


def test_starting_shell_needs_mask_support_outside_the_body_only():
    distance = np.array([-0.1, 0.05, 0.05, 0.2])
    mask_fraction = np.array([0.0, 0.9, 0.3, 1.0])
    assert initial_occupancy(distance, mask_fraction, 0.1, 0.6).tolist() == [True, True, False, False]


def test_unproven_cells_are_dark_or_filmed_from_one_side_and_off_the_body():
    update, random = ball_grid(False), np.random.default_rng(0)
    centres = torch.from_numpy(cell_centres(BOUNDS))
    radius = centres.norm(dim=1)
    left, above = centres[:, 0] < 0, centres[:, 1] > RADIUS_M
    points = centres[left & (radius < 0.8)]
    update.record_observations(points, torch.ones(len(points)), torch.zeros(len(points)))
    assert len(update.unobserved) == 0
    update.update(lambda points: torch.full((len(points),), 50.0), 0.01, random)
    unobserved = torch.zeros(len(centres), dtype=torch.bool)
    unobserved[update.unobserved] = True
    assert unobserved[(~left | above) & (radius > 0.54) & (radius < 0.78)].all()
    assert unobserved[above & (radius > 0.52) & (radius < 0.78)].all()
    assert not unobserved[(left & ~above) | (~above & (radius < 0.53)) | (radius < 0.51) | (radius > 0.8)].any()
    cells = update.unobserved[:500]
    inside = (update.sample_in_cells(cells, random) - centres[cells]).abs() * RESOLUTION / 2
    assert 0.45 < float(inside.max()) <= 0.5 + 1e-5
    points = update.sample_empty_points(0, 300, random)
    where = ((points + 1) * RESOLUTION / 2).floor().long()
    assert len(points) == 300
    assert unobserved[(where * torch.tensor([RESOLUTION**2, RESOLUTION, 1])).sum(1)].all()
    # What has become empty is asked for among the empty cells.
    for _ in range(60):
        update.update(lambda points: torch.zeros(len(points)), 0.01, random)
    assert len(update.unobserved) == 0
