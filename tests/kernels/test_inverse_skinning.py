import numpy as np
import pytest
import torch

from pipeline.kernels.inverse_skinning import bake_warp_grid, newton_step
from pipeline.kernels.inverse_skinning.reference import interpolate, skin_points
from pipeline.kernels.march import PackedWarpGrids, Rays, SamplingVolume, march
from tests.kernels.bar import CELL_M, bar_points, bar_skin, bend

EVERYWHERE = (torch.ones(2, 2, 2, dtype=torch.uint8), torch.tensor([[-9.0, -9, -9], [9, 9, 9]]))


def query_warp_grids(posed, warps, frame=0):
    """Canonical candidates of posed points, and the point that each belongs to: rays with a single step."""
    count = len(posed)
    directions = torch.tensor([[0.0, 0.0, 1.0]]).expand(count, 3)
    rays = Rays(posed, directions, torch.full((count,), frame), torch.zeros(count))
    samples = march(rays, SamplingVolume(warps, *EVERYWHERE), 99.0)
    return samples.canonical_m, torch.repeat_interleave(torch.arange(count), samples.ray_offsets.diff())


def bake(skin, matrices):
    """The warp grid of one frame."""
    return PackedWarpGrids.from_grids([bake_warp_grid(skin, matrices)], CELL_M)


def skin_point_by_hand(skin, matrices, point):
    """A(x) x of one point, by the definition."""
    origin_m = skin.origin_m.numpy()
    low = np.floor((point - origin_m) / skin.cell_m).astype(int)
    part = (point - origin_m) / skin.cell_m - low
    matrix = np.zeros((4, 4))
    for corner in np.ndindex(2, 2, 2):
        corner_weight = np.prod([p if bit else 1 - p for p, bit in zip(part, corner, strict=True)])
        weights = skin.weights[skin.row_of_node[tuple(low + corner)]].numpy()
        matrix += corner_weight * np.einsum("j,jab->ab", weights, matrices.numpy())
    return (matrix @ np.append(point, 1))[:3]


def test_forward_skinning_is_linear_blending_by_hand():
    skin, matrices, points = bar_skin(), bend(0.7), bar_points(20)
    posed = skin_points(points, skin.blend(matrices[None])[:, 0], skin.lattice)
    for point, carried in zip(points.numpy(), posed.numpy(), strict=True):
        np.testing.assert_allclose(carried, skin_point_by_hand(skin, matrices, point), atol=1e-6)


@pytest.mark.parametrize("angle", [0.0, 0.5, 1.2])
def test_warp_grid_inverts_skinning_within_a_millimetre(angle):
    skin, matrices, points = bar_skin(), bend(angle), bar_points(3000)
    blended = skin.blend(matrices[None])
    posed = skin_points(points, blended[:, 0], skin.lattice)
    found, point_indices = query_warp_grids(posed, bake(skin, matrices))
    assert torch.equal(point_indices, torch.arange(len(points)))
    error_m = (found - points).norm(dim=1)
    # Cells of 5 cm, and a joint that bends over 16 cm: a lookup is accurate to millimetres, one step to 0.1 mm.
    assert float(error_m.quantile(0.5)) < 1e-3
    refined = newton_step(blended, found, posed, torch.tensor([0, len(found)]), skin)
    assert float((refined - points).norm(dim=1).quantile(0.99)) < 1e-3
    back = skin_points(refined, blended[:, 0], skin.lattice)
    assert float((back - posed).norm(dim=1).quantile(0.99)) < 1e-3


def test_folded_bar_has_both_inverses():
    skin, matrices = bar_skin(), bend(np.pi - 0.35)
    # The second bone, rotated by almost 180 degrees, overlaps the first; these points are at equal depth in both.
    points = torch.tensor([[-0.4, 0.073, 0.0], [-0.45, 0.081, 0.03], [-0.5, 0.09, -0.04]])
    found, point_indices = query_warp_grids(points, bake(skin, matrices))
    blended = skin.blend(matrices[None])[:, 0]
    for index in range(len(points)):
        mine = found[point_indices == index]
        assert len(mine) == 2
        carried = skin_points(mine, blended, skin.lattice)
        assert float((carried - points[index]).norm(dim=1).max()) < 3e-3
        assert sorted(torch.sign(mine[:, 0]).tolist()) == [-1, 1]


def test_inverse_far_from_the_body_is_dropped():
    skin, matrices = bar_skin(), bend(np.pi - 0.35)
    # As above, but deep in one bone and near the surface of the other: a point where an arm overlaps the torso.
    points = torch.tensor([[-0.4, 0.0, 0.0], [-0.4, 0.145, 0.0], [-0.3, 0.02, 0.0]])
    found, point_indices = query_warp_grids(points, bake(skin, matrices))
    assert point_indices.tolist() == [0, 1, 2]
    assert torch.sign(found[:2, 0]).tolist() == [-1, 1]


def test_points_far_from_the_body_have_no_inverse():
    far = torch.tensor([[0.0, 0.0, 0.5], [3.0, 0.0, 0.0]])
    found, _ = query_warp_grids(far, bake(bar_skin(), bend(0.3)))
    assert len(found) == 0


def bent_and_twisted(angle_rad):
    """The bar bent, twisted and rotated in the world, so that no entry of a Jacobian is zero."""
    matrices = bend(angle_rad)
    matrices[1] = matrices[1] @ rotation_matrix([0.6 * angle_rad, 0.0, 0.0])
    return rotation_matrix([0.5, -0.7, 0.9]) @ matrices


def rotation_matrix(axis_angle_rad):
    """Rotation as a matrix (4, 4)."""
    matrix = torch.eye(4)
    matrix[:3, :3] = torch.linalg.matrix_exp(
        torch.linalg.cross(torch.tensor(axis_angle_rad).expand(3, 3), torch.eye(3)).T
    )
    return matrix


def two_frames():
    skin = bar_skin()
    blended = skin.blend(torch.stack([bent_and_twisted(0.4), bent_and_twisted(-0.8)]))
    points = bar_points(60)
    frame_offsets = torch.tensor([0, 25, 60])
    posed = torch.cat([skin_points(points[a:b], blended[:, f], skin.lattice) for f, a, b in ((0, 0, 25), (1, 25, 60))])
    random = torch.Generator().manual_seed(9)
    start = points + 0.004 * torch.randn(points.shape, generator=random)
    return skin, blended, start, posed, frame_offsets


def test_newton_step_and_gradient_match_reference():
    skin, blended, start, posed, frame_offsets = two_frames()
    grad_output = torch.randn(60, 3, generator=torch.Generator().manual_seed(1))
    results = []
    for dtype in (torch.float32, torch.float64):
        leaf = blended.to(dtype).clone().requires_grad_(True)
        solved = newton_step(leaf, start.to(dtype), posed.to(dtype), frame_offsets, skin)
        (solved * grad_output.to(dtype)).sum().backward()
        results.append((solved.detach().double(), leaf.grad.double()))
    torch.testing.assert_close(results[0][0], results[1][0], atol=1e-6, rtol=0)
    torch.testing.assert_close(results[0][1], results[1][1], atol=1e-4, rtol=1e-4)


def test_pose_gradient_is_the_finite_difference_of_the_solution():
    skin = bar_skin()
    point = bar_points(8, seed=5).double()
    posed = skin_points(point, skin.blend(bend(0.6, torch.float64)[None])[:, 0], skin.lattice)
    frame_offsets = torch.tensor([0, 8])

    def solve(angle):
        blended = skin.blend(bend(angle, torch.float64)[None])
        solved = point
        for _ in range(12):
            solved = newton_step(blended, solved, posed, frame_offsets, skin)
        return solved

    matrices = bend(0.6, torch.float64)
    direction = (bend(0.6 + 1e-6, torch.float64) - bend(0.6 - 1e-6, torch.float64)) / 2e-6
    numeric = (solve(0.6 + 1e-5) - solve(0.6 - 1e-5)) / 2e-5
    for dtype, tolerance in ((torch.float64, 1e-5), (torch.float32, 2e-4)):
        leaf = matrices.to(dtype).requires_grad_(True)
        solved = newton_step(skin.blend(leaf[None]), point.to(dtype), posed.to(dtype), frame_offsets, skin)
        for sample in range(8):
            for axis in range(3):
                (gradient,) = torch.autograd.grad(solved[sample, axis], leaf, retain_graph=True)
                analytic = float((gradient.double() * direction).sum())
                assert analytic == pytest.approx(float(numeric[sample, axis]), abs=tolerance)


def test_weights_outside_the_grid_are_those_of_the_nearest_node():
    skin = bar_skin()
    weights = skin.interpolate_weights(torch.tensor([[2.0, 0.0, 0.0], [-2.0, 0.0, 0.0], [0.0, 0.0, 0.0]]))
    assert weights[0].tolist() == pytest.approx([0, 1], abs=1e-3)
    assert weights[1].tolist() == pytest.approx([1, 0], abs=1e-3)
    assert weights[2].tolist() == pytest.approx([0.5, 0.5], abs=1e-3)


def test_interpolation_ignores_missing_nodes():
    rows = torch.arange(8).view(2, 2, 2)
    rows[1, 1, 1] = -1
    values = torch.ones(8, 1, dtype=torch.float64)
    inside = torch.full((1, 3), 0.5, dtype=torch.float64)
    assert float(interpolate(inside, (torch.zeros(3), 1.0, rows), values)) == pytest.approx(1.0)


def test_cropped_grid_equals_the_full_grid_in_occupied_cells():
    skin = bar_skin()
    bounds = np.array([[-0.63, -0.16, -0.14], [0.62, 0.17, 0.15]], dtype=np.float32)
    occupied = np.zeros((30, 9, 7), dtype=np.uint8)
    occupied[3:5, 4, 2:4] = occupied[20, 6, 5] = 1
    part = skin.crop_to_occupied(torch.from_numpy(occupied), torch.from_numpy(bounds))
    assert 0 < len(part.nodes_m) < 0.3 * len(skin.nodes_m)
    random = np.random.default_rng(0)
    cells = np.argwhere(occupied)[random.integers(0, occupied.sum(), 200)]
    points = bounds[0] + (cells + random.random((200, 3))) / occupied.shape * (bounds[1] - bounds[0])
    inside = torch.from_numpy(points.astype(np.float32))
    matrices = bend(0.5)[None]
    for grid in (skin, part):
        rows = grid.row_of_node[grid.row_of_node >= 0]
        assert rows.tolist() == list(range(len(grid.nodes_m)))
    truth = skin_points(inside, skin.blend(matrices)[:, 0], skin.lattice)
    torch.testing.assert_close(skin_points(inside, part.blend(matrices)[:, 0], part.lattice), truth, atol=0, rtol=0)
    away = torch.tensor([[0.0, 0.1, 0.1]])
    start = newton_step(part.blend(matrices), away, away, torch.tensor([0, 1]), part)
    assert torch.equal(start, away)
