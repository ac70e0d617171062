import math

import pytest
import torch

from pipeline.kernels.inverse_skinning import bake_warp_grid
from pipeline.kernels.march import PackedWarpGrids, march
from pipeline.kernels.transmittance_stats import update_voxel_maxima
from tests.kernels.bar import CELL_M, bar_skin, bend

BOUNDS = torch.tensor([[-0.6, -0.15, -0.15], [0.6, 0.15, 0.15]])


def warps(*angles):
    skin = bar_skin()
    return PackedWarpGrids.of([bake_warp_grid(skin, bend(angle)) for angle in angles], CELL_M)


def rays(count=400, frames=2, seed=0):
    random = torch.Generator().manual_seed(seed)
    targets = (torch.rand(count, 3, generator=random) - 0.5) * torch.tensor([1.0, 0.4, 0.2])
    origins = torch.randn(count, 3, generator=random) * 0.3 + torch.tensor([0.0, 0.0, 1.5])
    directions = torch.nn.functional.normalize(targets - origins, dim=-1)
    frame = torch.randint(frames, (count,), generator=random).sort().values
    return origins, directions, frame, torch.rand(count, generator=random)


def test_unbent_bar_is_sampled_at_constant_steps():
    """Unbent, a ray along -z through the bar meets every stop within its 0.3 m."""
    origins, directions = torch.tensor([[0.1, 0.02, 2.0]]), torch.tensor([[0.0, 0.0, -1.0]])
    occupied = torch.ones(8, 4, 4, dtype=torch.uint8)
    frame, jitter = torch.zeros(1, dtype=torch.long), torch.full((1,), 0.5)
    samples = march(origins, directions, frame, jitter, 0.01, warps(0.0), occupied, BOUNDS)
    assert len(samples.distance_m) == 30
    truth = origins + samples.distance_m[:, None] * directions
    torch.testing.assert_close(samples.canonical_m, truth, atol=1e-5, rtol=0)
    torch.testing.assert_close(samples.distance_m.diff(), torch.full((29,), 0.01), atol=1e-5, rtol=0)


def test_empty_cells_are_skipped():
    occupied = torch.zeros(8, 4, 4, dtype=torch.uint8)
    occupied[:, :, 2] = 1
    origins, directions = torch.tensor([[0.1, 0.02, 2.0]]), torch.tensor([[0.0, 0.0, -1.0]])
    frame, jitter = torch.zeros(1, dtype=torch.long), torch.full((1,), 0.5)
    samples = march(origins, directions, frame, jitter, 0.005, warps(0.0), occupied, BOUNDS)
    assert len(samples.distance_m) == pytest.approx(0.075 / 0.005, abs=1)
    assert float(samples.canonical_m[:, 2].min()) >= 0
    assert float(samples.canonical_m[:, 2].max()) <= 0.075


def test_matches_its_twin_sample_by_sample():
    random = torch.Generator().manual_seed(7)
    occupied = (torch.rand(16, 8, 8, generator=random) < 0.5).to(torch.uint8)
    arrays, both = rays(), warps(0.9, math.pi - 0.4)
    ours = march(*arrays, 0.013, both, occupied, BOUNDS, max_samples=12)
    origins, directions, frame, jitter = arrays
    exact = (origins.double(), directions.double(), frame, jitter.double())
    twin = march(*exact, 0.013, both, occupied, BOUNDS.double(), 12)
    ours_count, twin_count = ours.ray_offsets.diff(), twin.ray_offsets.diff()
    assert int(ours_count.max()) == 12
    assert int(ours_count.sum()) > 1000
    # A stop that falls on a cell's border within float32 may go either way.
    same = ours_count == twin_count
    assert float(same.float().mean()) > 0.985
    for ray in torch.nonzero(same)[:, 0].tolist():
        mine = ours.canonical_m[ours.ray_offsets[ray] : ours.ray_offsets[ray + 1]].double()
        theirs = twin.canonical_m[twin.ray_offsets[ray] : twin.ray_offsets[ray + 1]]
        torch.testing.assert_close(mine, theirs, atol=2e-3, rtol=0)


def test_rays_that_miss_have_no_samples():
    origins, directions = torch.tensor([[5.0, 0.0, 2.0]]), torch.tensor([[0.0, 0.0, -1.0]])
    samples = march(
        origins,
        directions,
        torch.zeros(1, dtype=torch.long),
        torch.zeros(1),
        0.01,
        warps(0.0),
        torch.ones(2, 2, 2, dtype=torch.uint8),
        BOUNDS,
    )
    assert samples.ray_offsets.tolist() == [0, 0]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_voxel_maxima_keep_the_largest_sample(dtype):
    bounds = torch.tensor([[0.0, 0, 0], [1, 1, 1]], dtype=dtype)
    points = torch.tensor([[0.1, 0.1, 0.1], [0.2, 0.1, 0.1], [0.9, 0.1, 0.6], [1.5, 0.1, 0.1]], dtype=dtype)
    transmittance, weight = (
        torch.tensor([0.3, 0.9, 0.5, 1.0], dtype=dtype),
        torch.tensor([0.2, 0.1, 0.4, 1.0], dtype=dtype),
    )
    max_transmittance, max_weight = torch.zeros(8, dtype=dtype), torch.full((8,), 0.15, dtype=dtype)
    update_voxel_maxima(points, transmittance, weight, bounds, (2, 2, 2), max_transmittance, max_weight)
    assert max_transmittance.tolist() == pytest.approx([0.9, 0, 0, 0, 0, 0.5, 0, 0])
    assert max_weight.tolist() == pytest.approx([0.2, 0.15, 0.15, 0.15, 0.15, 0.4, 0.15, 0.15])
