import numpy as np
import pytest
import torch

from pipeline.kernels.hashgrid import FeatureGradients, GridLayout, add_table_gradient_, encode, reference

# A dense level, a level that has slightly too many nodes to be dense, two hashed levels.
CELLS = ((3, 5, 2), (9, 9, 9), (40, 70, 20), (300, 500, 150))


def make(features, log2_rows=9, points=700):
    layout = GridLayout(CELLS, features, log2_rows)
    random = torch.Generator().manual_seed(features)
    table = torch.randn(layout.rows, features, generator=random)
    return layout, torch.rand(points, 3, generator=random), table


def corner_sum(point, table, cells, rows):
    """One dense level at one point, by the definition."""
    total = np.zeros(table.shape[1])
    low = np.minimum(np.floor(point * cells), np.array(cells) - 1).astype(int)
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod([part if bit else 1 - part for part, bit in zip(point * cells - low, corner, strict=True)])
        x, y, z = low + corner
        total += weight * table[x + (cells[0] + 1) * (y + (cells[1] + 1) * z)]
    return total


def test_layout_counts_rows():
    layout = GridLayout(CELLS, 4, 9)
    assert layout.rows_per_level == (72, 512, 512, 512)
    assert layout.rows == 1608
    assert layout.width == 16
    assert layout.level_params[:, 5].tolist() == [1, 0, 0, 0]
    with pytest.raises(ValueError, match="features"):
        GridLayout(CELLS, 3, 9)


def test_dense_level_is_trilinear_interpolation():
    layout, points, table = make(2)
    encoded = encode(points, table, layout)
    for index in range(0, 700, 50):
        truth = corner_sum(points[index].double().numpy(), table.double().numpy(), CELLS[0], 72)
        np.testing.assert_allclose(encoded[index, :2].numpy(), truth, atol=2e-6)


@pytest.mark.parametrize("features", [1, 2, 4, 8])
def test_compiled_encoding_matches_reference_in_float64(features):
    layout, points, table = make(features)
    table.requires_grad_(True)
    points.requires_grad_(True)
    encoded = encode(points, table, layout)
    random = torch.Generator().manual_seed(0)
    grad_output = torch.randn(encoded.shape, generator=random)
    # As in a training step, many points have a zero gradient.
    grad_output[::3] = 0
    grad_output[1::3, :-1] = 0
    encoded.backward(grad_output)
    points64, table64 = points.detach().double().requires_grad_(True), table.detach().double().requires_grad_(True)
    truth = encode(points64, table64, layout)
    truth.backward(grad_output.double())
    # float32 positions times 500 cells are rounded to 3e-5 of a cell.
    torch.testing.assert_close(encoded.double(), truth, atol=3e-4, rtol=0)
    torch.testing.assert_close(table.grad.double(), table64.grad, atol=1e-3, rtol=1e-4)
    torch.testing.assert_close(points.grad.double(), points64.grad, atol=0.2, rtol=1e-3)


def test_reference_passes_gradcheck():
    layout = GridLayout(((3, 2, 2), (7, 6, 5)), 2, 5)
    random = torch.Generator().manual_seed(1)
    table = torch.randn(layout.rows, 2, generator=random, dtype=torch.float64, requires_grad=True)
    points = (0.05 + 0.9 * torch.rand(6, 3, generator=random, dtype=torch.float64)).requires_grad_(True)
    assert torch.autograd.gradcheck(lambda p, t: reference.encode(p, t, layout.level_params), (points, table))


def test_points_outside_are_clamped():
    layout, _, table = make(4)
    outside = torch.tensor([[-0.5, 0.3, 1.7], [2.0, -1.0, 0.5], [1.0, 1.0, 1.0]])
    torch.testing.assert_close(encode(outside, table, layout), encode(outside.clamp(0, 1), table, layout))
    torch.testing.assert_close(
        encode(outside, table, layout).double(), encode(outside.double(), table.double(), layout), atol=1e-4, rtol=0
    )


def test_deferred_table_gradient_equals_autograd():
    layout, points, table = make(4)
    table.requires_grad_(True)
    encode(points, table, layout).square().sum().backward()
    alone = table.grad.clone()
    table.grad = None
    feature_gradients: FeatureGradients = []
    for half in points.tensor_split(2):
        encode(half, table, layout, feature_gradients).square().sum().backward()
    assert table.grad is None
    assert len(feature_gradients) == 2
    sums = torch.ones_like(alone)
    add_table_gradient_(sums, feature_gradients, layout)
    torch.testing.assert_close(sums, alone + 1)


def test_gradients_are_bitwise_deterministic():
    layout, points, table = make(8, points=5000)
    points.requires_grad_(True)
    table.requires_grad_(True)
    runs = []
    for _ in range(2):
        points.grad = table.grad = None
        encode(points, table, layout).square().sum().backward()
        runs.append((points.grad.clone(), table.grad.clone()))
    assert torch.equal(runs[0][0], runs[1][0])
    assert torch.equal(runs[0][1], runs[1][1])
