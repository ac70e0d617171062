import numpy as np
import pytest
import torch

from pipeline.field.losses import field_loss_gradients, field_losses
from pipeline.field.pixel_sampler import ErrorMap, build_pixel_pool
from pipeline.field.settings import FieldSettings

SETTINGS = FieldSettings(huber_delta=0.1, alpha_weight=0.5, hard_surface_weight=0.2, empty_density_weight=0.1)


def test_a_perfect_image_has_zero_loss():
    rgba = torch.tensor([[0.2, 0.4, 0.6, 1.0], [0.9, 0.1, 0.5, 0.0]])
    solid = rgba[:, :3] * rgba[:, 3:]
    losses, error = field_losses(solid, rgba[:, 3], rgba, torch.rand(2, 3), torch.ones(2), torch.zeros(5), SETTINGS)
    assert float(error.abs().max()) < 1e-7
    assert set(losses) == {"colour", "alpha", "hard", "density"}
    for name, value in losses.items():
        assert float(value) == pytest.approx(0, abs=1e-6), name


def test_a_hole_in_the_body_has_an_alpha_loss_for_any_background():
    rgba = torch.tensor([[1.0, 1.0, 1.0, 1.0]])
    nothing = torch.zeros(1, 3), torch.zeros(1)
    losses, _ = field_losses(*nothing, rgba, torch.ones(1, 3), torch.ones(1), torch.zeros(0), SETTINGS)
    assert float(losses["colour"]) == 0
    assert float(losses["alpha"]) == pytest.approx(0.5 * 0.95)
    assert "density" not in losses


@pytest.mark.parametrize("points", [0, 7])
def test_gradients_without_autograd_are_those_of_the_losses(points):
    random = torch.Generator().manual_seed(4)
    shapes = ((50, 3), 50, (50, 4), (50, 3), 50)
    image, alpha, rgba, background, weight = (torch.rand(shape, generator=random) for shape in shapes)
    density = 20 * torch.rand(points, generator=random)
    found, error, gradients = field_loss_gradients(image, alpha, rgba, background, weight, density, SETTINGS, 0.3)
    outputs = [tensor.clone().requires_grad_() for tensor in (image, alpha, density)]
    expected, expected_error = field_losses(*outputs[:2], rgba, background, weight, outputs[2], SETTINGS)
    expected = {name: loss if name == "density" else 0.3 * loss for name, loss in expected.items()}
    assert found.keys() == expected.keys()
    for name, loss in expected.items():
        torch.testing.assert_close(found[name], loss.detach())
    torch.testing.assert_close(error, expected_error)
    total = torch.stack(list(expected.values())).sum()
    by_autograd = torch.autograd.grad(total, outputs, allow_unused=True)
    for mine, theirs, output in zip(gradients, by_autograd, outputs, strict=True):
        torch.testing.assert_close(mine, torch.zeros_like(output) if theirs is None else theirs)


def make_pool():
    mask = np.zeros((60, 40), np.uint8)
    mask[10:50, 10:30] = 255
    image = np.random.default_rng(0).integers(0, 256, (60, 40, 3), dtype=np.uint8)
    empty = np.zeros_like(mask)
    return build_pixel_pool([(image, mask), (image, empty), (image, mask)], 3, seed=0), image, mask


def test_pool_classifies_pixels():
    pool, image, mask = make_pool()
    columns, rows = pool.xy_px.T
    np.testing.assert_array_equal(pool.rgba[:, :3], np.concatenate([image[rows, columns]]))
    body = slice(pool.start[0, 0], pool.start[0, 1])
    outside = slice(pool.start[0, 2], pool.start[0, 3])
    assert (pool.rgba[body, 3] == 255).all()
    assert (pool.rgba[outside, 3] == 0).all()
    assert body.stop - body.start == (40 - 6) * (20 - 6)
    assert (pool.start[1] == pool.start[1, 0]).all()
    places = pool.xy_px[pool.start[0, 0] : pool.start[0, 3]]
    assert len(np.unique(places, axis=0)) == len(places)


def test_classes_have_the_requested_number_of_rays():
    pool, _, _ = make_pool()
    sample_counts = pool.sample_counts(np.array([0, 1, 2]), 300.0, (0.6, 0.3, 0.1))

    def drawn(frame):
        return pool.sample_pixels(
            np.array([frame]), sample_counts[[frame]], [np.random.default_rng(0)], ErrorMap(3, pool.xy_px)
        )[0]

    assert sample_counts.tolist() == [[180, 90, 30], [0, 0, 0], [180, 90, 30]]
    rows = drawn(0)
    assert (np.diff(rows) >= 0).all()
    classes = np.searchsorted(pool.start[0], rows, side="right") - 1
    assert np.bincount(classes).tolist() == [180, 90, 30]
    np.testing.assert_array_equal(rows, drawn(0))
    assert len(drawn(1)) == 0
