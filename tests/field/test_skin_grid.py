import numpy as np
import pytest
import torch

from pipeline.body.body import canonical_to_world
from pipeline.field.skin_grid import bake_warp_grids, build_skin_grid, skin_margin_m, world_to_posed
from pipeline.geometry.skinning import linear_blend_skinning
from pipeline.geometry.surface import signed_distance_m
from pipeline.kernels.inverse_skinning import newton_step
from pipeline.kernels.inverse_skinning.reference import skin_points
from pipeline.kernels.march import Rays, SamplingVolume, march
from tests.field.scene import make_motion


@pytest.fixture(scope="module")
def skin(body):
    return build_skin_grid(body, 0.06)


def test_grid_extends_just_beyond_the_margin(body, skin):
    assert float(skin.distance_m.max()) < 0.06 + 2.5 * skin.cell_m
    assert float(skin.distance_m.min()) < -0.05
    torch.testing.assert_close(skin.weights.sum(1), torch.ones(len(skin.weights)), atol=1e-5, rtol=0)
    bounds = np.stack([body.vertices.min(0) - 0.06, body.vertices.max(0) + 0.06])
    assert skin_margin_m(body, bounds) == pytest.approx(0.06, abs=1e-6)


def test_grid_skins_the_surface_like_the_weights_of_the_body(body, skin):
    motion = make_motion(body, 2, bend_rad=0.15)
    matrices = canonical_to_world(body, motion)
    vertices = torch.from_numpy(body.vertices)
    truth = linear_blend_skinning(vertices, torch.from_numpy(body.skin_weights), matrices)[1]
    ours = skin_points(vertices, skin.blend(matrices[1:])[:, 0], skin.lattice)
    error_m = (ours - truth).norm(dim=1)
    # Weights are smoothed over half a cell; fingers are as thin as that and differ by millimetres.
    assert float(error_m.median()) < 1e-3
    assert float(error_m.quantile(0.95)) < 6e-3


def test_weights_are_continuous(skin):
    rng = np.random.default_rng(0)
    inside = skin.nodes_m[skin.distance_m < 0.06].numpy()
    points = torch.from_numpy(inside[rng.integers(0, len(inside), 3000)])
    moved = points + 0.001 * torch.nn.functional.normalize(torch.randn(points.shape), dim=-1)
    change = (skin.interpolate_weights(points) - skin.interpolate_weights(moved)).abs().sum(1)
    # Nearest-vertex weights change by 2 within a millimetre between two limbs.
    assert float(change.max()) < 0.35


def test_posed_space_follows_the_root(body):
    motion = make_motion(body, 4)
    matrices = canonical_to_world(body, motion)
    posed = world_to_posed(matrices) @ matrices[:, 0]
    torch.testing.assert_close(posed, torch.eye(4).expand(4, 4, 4), atol=1e-5, rtol=0)


def test_lookup_and_one_newton_step_invert_skinning(body, skin):
    motion = make_motion(body, 3, bend_rad=0.12)
    world = canonical_to_world(body, motion)
    posed_matrices = world_to_posed(world)[:, None] @ world
    warps = bake_warp_grids(skin, posed_matrices)
    rng = np.random.default_rng(1)
    points = skin.nodes_m.numpy()[rng.integers(0, len(skin.nodes_m), 4000)]
    points = points + rng.uniform(-0.5, 0.5, points.shape).astype(np.float32) * skin.cell_m
    points = torch.from_numpy(points[signed_distance_m(points, body.mesh()) < 0.05])
    blended = skin.blend(posed_matrices[2:])
    posed = skin_points(points, blended[:, 0], skin.lattice)
    count = len(points)
    directions, frame = torch.tensor([[0.0, 0.0, 1.0]]).expand(count, 3), torch.full((count,), 2)
    box_m = torch.tensor([[-9.0, -9, -9], [9, 9, 9]])
    volume = SamplingVolume(warps, torch.ones(2, 2, 2, dtype=torch.uint8), box_m)
    samples = march(Rays(posed, directions, frame, torch.zeros(count)), volume, 99.0)
    point_indices = torch.repeat_interleave(torch.arange(count), samples.ray_offsets.diff())
    assert float((samples.ray_offsets.diff() > 0).float().mean()) > 0.995
    refined = newton_step(
        blended, samples.canonical_m, posed[point_indices], torch.tensor([0, len(point_indices)]), skin
    )
    back = skin_points(refined, blended[:, 0], skin.lattice)
    assert float((back - posed[point_indices]).norm(dim=1).quantile(0.99)) < 1e-3
    error_m = (refined - points[point_indices]).norm(dim=1)
    assert float(error_m.median()) < 1e-4
    assert float((error_m < 1e-3).float().mean()) > 0.97


def test_baking_does_not_depend_on_the_number_of_threads(body, skin):
    world = canonical_to_world(body, make_motion(body, 2))
    matrices = world_to_posed(world)[:, None] @ world
    threads = torch.get_num_threads()
    results = []
    for count in (1, 2):
        torch.set_num_threads(count)
        results.append(bake_warp_grids(skin, matrices))
    torch.set_num_threads(threads)
    for one, two in zip(results[0].tensors(), results[1].tensors(), strict=True):
        assert torch.equal(one.nan_to_num(), two.nan_to_num())
