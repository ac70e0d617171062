import numpy as np
import pytest
import torch

from pipeline.kernels.broyden import CANDIDATES, find_roots
from pipeline.kernels.inverse_skinning import SkinGrid, newton_step
from pipeline.kernels.inverse_skinning.reference import skin_points
from tests.kernels.bar import bar_points, bar_skin, bend
from tests.kernels.test_inverse_skinning import bake, query_warp_grids


def run(skin, matrices, posed, frame=None):
    """Search with all bones as starts; matrices (j, 4, 4) of one frame or (k, j, 4, 4)."""
    matrices = matrices if matrices.dim() == 4 else matrices[None]
    frame = torch.zeros(len(posed), dtype=torch.long) if frame is None else frame
    return find_roots(posed, frame, matrices, skin.blend(matrices), skin)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_single_bone_inverse_is_the_matrix_inverse(dtype):
    bar = bar_skin()
    skin = SkinGrid(bar.origin_m, bar.cell_m, bar.row_of_node, bar.nodes_m, bar.distance_m, bar.weights[:, :1] * 0 + 1)
    matrix = bend(0.8, dtype)[1]
    matrix[:3, 3] = torch.tensor([0.3, -1.0, 0.2], dtype=dtype)
    posed = bar_points(200).to(dtype) @ matrix[:3, :3].T + matrix[:3, 3]
    roots, exists = run(skin, matrix[None], posed)
    closed_form = (posed - matrix[:3, 3]) @ matrix[:3, :3]
    assert exists.sum(1).tolist() == [1] * 200
    torch.testing.assert_close(roots[:, 0], closed_form, atol=2e-6, rtol=0)


@pytest.mark.parametrize("angle", [0.5, 1.2])
def test_roots_agree_with_the_warp_grid_on_a_bent_bar(angle):
    skin, matrices, points = bar_skin(), bend(angle), bar_points(2000)
    blended = skin.blend(matrices[None])
    posed = skin_points(points, blended[:, 0], skin.lattice)
    roots, exists = run(skin, matrices, posed)
    truth = ((roots - points[:, None]).norm(dim=2) < 1e-3) & exists
    assert float(truth.any(1).float().mean()) > 0.995
    baked, point_indices = query_warp_grids(posed, bake(skin, matrices))
    refined = newton_step(blended, baked, posed[point_indices], torch.tensor([0, len(point_indices)]), skin)
    apart_m = (roots[point_indices] - refined[:, None]).norm(dim=2).masked_fill(~exists[point_indices], np.inf).amin(1)
    assert float((apart_m < 1e-3).float().mean()) > 0.99


def test_all_candidates_are_distinct_roots():
    skin, matrices = bar_skin(), bend(np.pi - 0.35)
    points = torch.cat([bar_points(1000), torch.tensor([[-0.4, 0.073, 0.0], [-0.45, 0.081, 0.03]])])
    roots, exists = run(skin, matrices, points)
    assert exists[-2:].sum(1).tolist() == [2, 2], "the folded bar covers these twice"
    point, candidate = torch.nonzero(exists, as_tuple=True)
    back = skin_points(roots[point, candidate], skin.blend(matrices[None])[:, 0], skin.lattice)
    assert float((back - points[point]).norm(dim=1).max()) < 2e-5
    for first in range(CANDIDATES):
        for second in range(first):
            both = exists[:, first] & exists[:, second]
            assert bool(((roots[:, first] - roots[:, second]).norm(dim=1)[both] > 1e-3).all())


def test_compiled_search_matches_reference():
    skin, matrices = bar_skin(), torch.stack([bend(0.9), bend(np.pi - 0.5)])
    points = torch.cat([bar_points(400), 2 * bar_points(200, seed=3)])
    frame = torch.arange(len(points)) % 2
    ours, expected = run(skin, matrices, points, frame), run(skin, matrices.double(), points.double(), frame)
    same = (ours[1] == expected[1]).all(1)
    # In float32 a search whose residual ends near the limit may be a root or not.
    assert float(same.float().mean()) > 0.98
    assert int(ours[1][:, 1].sum()) > 20
    torch.testing.assert_close(ours[0][same].double(), expected[0][same], atol=5e-4, rtol=0)


def test_far_points_have_no_roots():
    far = torch.tensor([[0.0, 0.0, 0.5], [3.0, 0.0, 0.0]])
    assert not run(bar_skin(), bend(0.3), far)[1].any()
