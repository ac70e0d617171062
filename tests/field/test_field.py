from unittest import mock

import numpy as np
import pytest
import torch

from pipeline.core.errors import UserError
from pipeline.field import field as field_module
from pipeline.field.field import (
    INITIAL_DENSITY_PER_M,
    MIN_RELATIVE_GRADIENT,
    RadianceField,
    _RadianceMlp,
    hash_grid_layout,
)
from pipeline.field.files import load_field, load_occupancy, save_field, save_occupancy
from pipeline.field.occupancy import BinaryOccupancy
from pipeline.io.tensors import load_tensors, save_tensors

BOUNDS = np.array([[-0.5, 0.0, -0.25], [0.5, 2.0, 0.25]], dtype=np.float32)


def make_field(seed=0):
    return RadianceField(BOUNDS, hash_grid_layout(BOUNDS, 0.02, 3, 4, 10), 16, seed)


def points(count=50):
    rng = torch.Generator().manual_seed(2)
    return torch.rand(count, 3, generator=rng) * torch.tensor([1.0, 2.0, 0.5]) + torch.tensor([-0.5, 0.0, -0.25])


def test_decoder_passes_gradcheck():
    rng = torch.Generator().manual_seed(0)
    shapes = ((7, 6), (6, 5), (5, 4), (4,))
    inputs = [0.5 * torch.randn(shape, generator=rng, dtype=torch.float64) for shape in shapes]
    inputs = [tensor.requires_grad_(True) for tensor in inputs]
    assert torch.autograd.gradcheck(_RadianceMlp.apply, inputs)


def test_decoder_keeps_a_gradient_beyond_the_clamp():
    features = torch.ones(1, 1, requires_grad=True)
    output = torch.tensor([[0.0, 0, 0, 50.0]])
    _, density = _RadianceMlp.apply(features, torch.ones(1, 1), output, torch.zeros(4))
    density.sum().backward()
    assert torch.isfinite(density).all()
    assert float(features.grad) > 0


def test_points_with_small_gradients_are_skipped_in_backward():
    rng = torch.Generator().manual_seed(0)
    inputs = [0.5 * torch.randn(shape, generator=rng, dtype=torch.float64) for shape in ((90, 6), (6, 5), (5, 4), (4,))]
    grad_outputs = [torch.randn(shape, generator=rng, dtype=torch.float64) for shape in ((90, 3), (90,))]
    for direction in grad_outputs:
        direction[:40] *= 1e-5
    gradients = []
    for fraction in (0.0, MIN_RELATIVE_GRADIENT):
        leaves = [tensor.clone().requires_grad_(True) for tensor in inputs]
        with mock.patch.object(field_module, "MIN_RELATIVE_GRADIENT", fraction):
            torch.autograd.backward(_RadianceMlp.apply(*leaves), grad_outputs)
        gradients.append([leaf.grad for leaf in leaves])
    assert gradients[0][0][:40].any()
    assert not gradients[1][0][:40].any()
    torch.testing.assert_close(gradients[1][0][40:], gradients[0][0][40:])
    for truth, found in zip(gradients[0][1:], gradients[1][1:], strict=True):
        assert float((found - truth).norm()) < MIN_RELATIVE_GRADIENT * float(truth.norm())


def test_initial_field_is_grey_with_the_initial_density():
    colour, density = make_field().requires_grad_(False)(points())
    assert float((density - INITIAL_DENSITY_PER_M).abs().max()) < 0.1
    assert float((colour - 0.5).abs().max()) < 0.01


def test_density_is_zero_outside_the_bounds():
    field = make_field()
    outside = torch.tensor([[0.6, 1.0, 0.0], [0.0, -0.1, 0.0], [0.0, 1.0, 0.3]])
    assert field(outside)[1].tolist() == [0, 0, 0]
    assert float(field.density(torch.tensor([[0.0, 1.0, 0.0]]))) > 0


def test_the_seed_determines_the_field():
    assert torch.equal(make_field(3).table, make_field(3).table)
    assert not torch.equal(make_field(3).table, make_field(4).table)


def test_layout_ends_at_the_finest_cell():
    layout = hash_grid_layout(BOUNDS, 0.004, 6, 2, 12)
    finest = np.array([1.0, 2.0, 0.5]) / np.array(layout.cells_per_axis[-1])
    np.testing.assert_allclose(finest, 0.004, rtol=0.02)
    coarsest = np.array([1.0, 2.0, 0.5]) / np.array(layout.cells_per_axis[0])
    np.testing.assert_allclose(coarsest, 0.125, rtol=0.01)
    sizes = [np.prod(cells) for cells in layout.cells_per_axis]
    assert sizes == sorted(sizes)


def test_field_round_trip(tmp_path):
    field = make_field(1)
    save_field(tmp_path / "field.safetensors", field)
    again = load_field(tmp_path / "field.safetensors")
    assert torch.equal(again(points())[1], field(points())[1])
    first = (tmp_path / "field.safetensors").read_bytes()
    save_field(tmp_path / "field.safetensors", again)
    assert (tmp_path / "field.safetensors").read_bytes() == first


def test_occupancy_round_trip(tmp_path):
    occupied = torch.zeros(4, 4, 4, dtype=torch.uint8)
    occupied[1, 2, 3] = 1
    save_occupancy(tmp_path / "o.npz", BinaryOccupancy(occupied, torch.from_numpy(BOUNDS)))
    again = load_occupancy(tmp_path / "o.npz")
    assert torch.equal(again.occupied, occupied)
    assert again.contains(torch.tensor([[-0.2, 1.3, 0.2], [0.2, 1.3, 0.2], [9.0, 0, 0]])).tolist() == [
        True,
        False,
        False,
    ]


def test_damaged_files_are_a_user_error(tmp_path):
    path = tmp_path / "field.safetensors"
    with pytest.raises(UserError, match="cannot be read"):
        load_tensors(path)
    path.write_bytes(b"not tensors at all")
    with pytest.raises(UserError, match="cannot be read"):
        load_field(path)
    save_tensors(path, {"a": torch.zeros(1)}, {"features": 4})
    with pytest.raises(UserError, match="holds no radiance field of this version"):
        load_field(path)
