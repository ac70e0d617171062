"""NaN in the input of a kernel: no access outside an array, every loop ends, other elements are not affected."""

import pytest
import torch

from pipeline.kernels.hashgrid import GridLayout, encode
from pipeline.kernels.inverse_skinning import bake_warp_grid, newton_step
from pipeline.kernels.march import PackedWarpGrids, Rays, SamplingVolume, march
from pipeline.kernels.texture_sampling import supersample_texture
from tests.kernels.bar import CELL_M, bar_skin, bend

NAN = float("nan")


def test_nan_coordinates_are_clamped_to_the_box() -> None:
    layout = GridLayout(((3, 5, 2), (40, 70, 20)), 2, 9)
    random = torch.Generator().manual_seed(0)
    table, points = torch.randn(layout.rows, 2, generator=random), torch.rand(300, 3, generator=random)
    points[::7, 0], points[5], points[9, 2] = NAN, NAN, NAN
    results = []
    for values in (points, points.nan_to_num(0.0)):
        leaves = values.clone().requires_grad_(True), table.clone().requires_grad_(True)
        encoded = encode(*leaves, layout)
        encoded.square().sum().backward()
        results.append((encoded.detach(), *(leaf.grad for leaf in leaves)))
    for found, expected in zip(*results, strict=True):
        assert torch.equal(found, expected)


@pytest.mark.parametrize("broken", [("origin", NAN), ("direction", NAN), ("direction", 0.0)])
def test_degenerate_ray_has_no_samples(broken: tuple[str, float]) -> None:
    origins, directions = torch.tensor([[0.1, 0.02, 2.0]]).repeat(5, 1), torch.tensor([[0.0, 0.0, -1.0]]).repeat(5, 1)
    warps = PackedWarpGrids.from_grids([bake_warp_grid(bar_skin(), bend(0.3))], CELL_M)
    occupied, box = torch.ones(8, 4, 4, dtype=torch.uint8), torch.tensor([[-0.6, -0.15, -0.15], [0.6, 0.15, 0.15]])
    frame, jitter = torch.zeros(5, dtype=torch.long), torch.full((5,), 0.5)
    volume = SamplingVolume(warps, occupied, box)
    whole = march(Rays(origins, directions, frame, jitter), volume, 0.01)
    origins[3] = 0.0
    {"origin": origins, "direction": directions}[broken[0]][3] = broken[1]
    samples = march(Rays(origins, directions, frame, jitter), volume, 0.01)
    counts = whole.ray_offsets.diff()
    assert int(counts.min()) > 0
    assert samples.ray_offsets.diff().tolist() == [*counts[:3].tolist(), 0, int(counts[4])]
    kept = torch.repeat_interleave(torch.arange(5), counts) != 3
    assert torch.equal(samples.canonical_m, whole.canonical_m[kept])


def test_nan_gradient_outside_the_grid_is_ignored() -> None:
    """The second point is 1 cm outside the grid: it has no nodes, and its indices refer to nodes of other points."""
    skin, matrices = bar_skin(), bend(0.4)
    start = torch.tensor([[0.2, 0.03, 0.04], [0.0, 0.16, 0.0]])
    blended = skin.blend(matrices[None]).requires_grad_(True)

    def gradient_of(upstream: list[float]) -> torch.Tensor:
        refined = newton_step(blended, start, start, torch.tensor([0, 2]), skin)
        (gradient,) = torch.autograd.grad(refined, blended, torch.tensor(upstream)[:, None].expand(2, 3))
        return gradient

    assert torch.equal(gradient_of([1.0, NAN]), gradient_of([1.0, 0.0]))
    assert float(gradient_of([1.0, NAN]).abs().max()) > 0


def test_nan_texture_coordinate_is_clamped() -> None:
    face_id, faces_uv = torch.zeros(1, 1, dtype=torch.int32), torch.tensor([[0, 1, 2]], dtype=torch.int32)
    barycentric, texture = torch.tensor([[[1.0, 0.0, 0.0]]]), torch.tensor([[[0.25], [0.5]], [[0.75], [1.0]]])
    uv = torch.tensor([[NAN, NAN], [0.0, 0.0], [0.0, 0.0]])
    assert supersample_texture(face_id, barycentric, faces_uv, uv, texture, 1).tolist() == [[[0.25, 1.0]]]
