"""Newton step by the joints of cells: the compiled loops against the definition, in values and gradients."""

import numpy as np
import torch

from pipeline.kernels.inverse_skinning import SkinGrid, cell_skinning_cpu, reference
from tests.kernels.bar import bar_points, bar_skin, bend

ANGLES = (0.5, -0.3)


def cropped_skin() -> SkinGrid:
    """The bar without the nodes at its left end: some cells have nodes and are not complete."""
    whole = bar_skin()
    kept = whole.nodes_m[:, 0] > -0.32
    row_of_node = torch.full((len(kept),), -1, dtype=torch.int32)
    row_of_node[kept] = torch.arange(int(kept.sum()), dtype=torch.int32)
    arrays = (whole.nodes_m[kept], whole.distance_m[kept], whole.weights[kept])
    return SkinGrid(whole.origin_m, whole.cell_m, row_of_node.view(whole.row_of_node.shape), *arrays)


def make_points(skin: SkinGrid) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Starts, targets 2 cm away from their posed positions, and frames; the last starts are outside the grid."""
    random = torch.Generator().manual_seed(1)
    start = torch.cat([bar_points(400), torch.tensor([[0.0, 0.16, 0.0], [-0.59, 0.0, 0.0], [2.0, 0.0, -9.0]])])
    frame = torch.arange(len(start)) % 2
    matrices = torch.stack([bend(angle) for angle in ANGLES])
    by_frame = [reference.skin_points(start, blended, skin.lattice) for blended in skin.blend(matrices).unbind(1)]
    posed = torch.where(frame[:, None] == 0, *by_frame)
    return start, posed + 0.02 * torch.randn(posed.shape, generator=random), frame


def test_step_and_gradient_match_the_reference() -> None:
    skin = cropped_skin()
    start, target, frame = make_points(skin)
    order = frame.argsort(stable=True)
    start, target, frame = start[order], target[order], frame[order]
    matrices = torch.stack([bend(angle + 0.05) for angle in ANGLES])
    points, inverse_jacobian = target.numpy().copy(), np.empty((len(start), 9), np.float32)
    rays, arrays = np.arange(len(start), dtype=np.int32), matrices.flatten(2).numpy()
    step = (rays, frame.numpy(), arrays, skin.cell_weights, start.numpy(), points, inverse_jacobian)
    cell_skinning_cpu.newton_steps(0, len(start), *step)

    exact = SkinGrid(
        skin.origin_m.double(), skin.cell_m, skin.row_of_node, skin.nodes_m, skin.distance_m, skin.weights.double()
    )
    leaf = matrices.double().requires_grad_()
    offsets = torch.tensor([0, int((frame == 0).sum()), len(frame)])
    expected = reference.newton_step(exact.blend(leaf), start.double(), target.double(), offsets, exact.lattice)
    # The reference extrapolates outside the lattice, the compiled loops do not.
    outside = ((start < skin.origin_m) | (start > -skin.origin_m)).any(1)
    moved = ((expected.detach() - start).norm(dim=1) > 0) & ~outside
    assert 250 < int(moved.sum()) < len(start) - 50
    np.testing.assert_array_equal(points[~moved], start[~moved].numpy())
    np.testing.assert_array_equal(inverse_jacobian[~moved], 0)
    torch.testing.assert_close(torch.from_numpy(points)[moved].double(), expected.detach()[moved], atol=1e-5, rtol=0)

    upstream = torch.randn(start.shape, generator=torch.Generator().manual_seed(2))
    (of_matrices,) = torch.autograd.grad((expected * upstream)[moved].sum(), leaf)
    upstream[~moved] = float("nan")
    gradient = np.zeros_like(arrays)
    rows = np.arange(len(start))
    cell_skinning_cpu.add_matrix_gradient(
        rows, frame.numpy(), start.numpy(), inverse_jacobian, upstream.numpy(), skin.cell_weights, gradient
    )
    ours = torch.from_numpy(gradient).view_as(leaf).double()
    assert float((ours - of_matrices).norm()) < 1e-5 * float(of_matrices.norm())


def test_grid_without_a_complete_cell_has_no_weights() -> None:
    empty = torch.zeros(0, 3)
    grid = SkinGrid(torch.zeros(3), 1.0, torch.full((3, 1, 2), -1, dtype=torch.int32), empty, empty[:, 0], empty)
    cells = grid.cell_weights
    assert cells.row_of_cell.shape == (2, 0, 1)
    assert len(cells.joint) == len(cells.weight) == 0
