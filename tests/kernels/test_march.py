import math

import pytest
import torch

from pipeline.kernels.inverse_skinning import bake_warp_grid
from pipeline.kernels.march import PackedWarpGrids, Rays, SamplingVolume, march
from pipeline.kernels.transmittance_stats import update_voxel_maxima
from tests.kernels.bar import CELL_M, bar_skin, bend

BOUNDS = torch.tensor([[-0.6, -0.15, -0.15], [0.6, 0.15, 0.15]])


def warps(*angles):
    skin = bar_skin()
    return PackedWarpGrids.from_grids([bake_warp_grid(skin, bend(angle)) for angle in angles], CELL_M)


def rays(count=400, frames=2, seed=0):
    random = torch.Generator().manual_seed(seed)
    targets = (torch.rand(count, 3, generator=random) - 0.5) * torch.tensor([1.0, 0.4, 0.2])
    origins = torch.randn(count, 3, generator=random) * 0.3 + torch.tensor([0.0, 0.0, 1.5])
    directions = torch.nn.functional.normalize(targets - origins, dim=-1)
    frame = torch.randint(frames, (count,), generator=random).sort().values
    return Rays(origins, directions, frame, torch.rand(count, generator=random))


def one_ray(x_m, jitter=0.5):
    """A ray along -z at y = 0.02 m."""
    origins, directions = torch.tensor([[x_m, 0.02, 2.0]]), torch.tensor([[0.0, 0.0, -1.0]])
    return Rays(origins, directions, torch.zeros(1, dtype=torch.long), torch.full((1,), jitter))


def test_unbent_bar_is_sampled_at_constant_steps():
    """A ray along -z through the straight bar has a sample at every step of its 0.3 m."""
    ray, volume = one_ray(0.1), SamplingVolume(warps(0.0), torch.ones(8, 4, 4, dtype=torch.uint8), BOUNDS)
    samples = march(ray, volume, 0.01)
    assert len(samples.distance_m) == 30
    truth = ray.origins_m + samples.distance_m[:, None] * ray.directions
    torch.testing.assert_close(samples.canonical_m, truth, atol=1e-5, rtol=0)
    torch.testing.assert_close(samples.distance_m.diff(), torch.full((29,), 0.01), atol=1e-5, rtol=0)


def test_empty_cells_are_skipped():
    occupied = torch.zeros(8, 4, 4, dtype=torch.uint8)
    occupied[:, :, 2] = 1
    samples = march(one_ray(0.1), SamplingVolume(warps(0.0), occupied, BOUNDS), 0.005)
    assert len(samples.distance_m) == pytest.approx(0.075 / 0.005, abs=1)
    assert float(samples.canonical_m[:, 2].min()) >= 0
    assert float(samples.canonical_m[:, 2].max()) <= 0.075


def test_samples_match_reference():
    random = torch.Generator().manual_seed(7)
    occupied = (torch.rand(16, 8, 8, generator=random) < 0.5).to(torch.uint8)
    single, both = rays(), warps(0.9, math.pi - 0.4)
    ours = march(single, SamplingVolume(both, occupied, BOUNDS), 0.013, max_samples=12)
    double = Rays(single.origins_m.double(), single.directions.double(), single.frame_index, single.jitter.double())
    expected = march(double, SamplingVolume(both, occupied, BOUNDS.double()), 0.013, max_samples=12)
    ours_count, expected_count = ours.ray_offsets.diff(), expected.ray_offsets.diff()
    assert int(ours_count.max()) == 12
    assert int(ours_count.sum()) > 1000
    # In float32 a step on the border of a cell may fall into either cell.
    same = ours_count == expected_count
    assert float(same.float().mean()) > 0.985
    for ray in torch.nonzero(same)[:, 0].tolist():
        mine = ours.canonical_m[ours.ray_offsets[ray] : ours.ray_offsets[ray + 1]].double()
        theirs = expected.canonical_m[expected.ray_offsets[ray] : expected.ray_offsets[ray + 1]]
        torch.testing.assert_close(mine, theirs, atol=2e-3, rtol=0)


def test_rays_that_miss_have_no_samples():
    volume = SamplingVolume(warps(0.0), torch.ones(2, 2, 2, dtype=torch.uint8), BOUNDS)
    samples = march(one_ray(5.0, jitter=0.0), volume, 0.01)
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
