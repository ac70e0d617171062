"""sRGB's curve: points of the standard, both directions, arrays and tensors."""

import numpy as np
import pytest
import torch

from pipeline.geometry.colour import linear_light, srgb_of_light


@pytest.mark.parametrize(
    ("srgb", "light"), [(0.0, 0.0), (0.02, 0.02 / 12.92), (0.5, 0.214041), (0.735357, 0.5), (1, 1)]
)
def test_known_points(srgb, light):
    assert linear_light(np.array([srgb]))[0] == pytest.approx(light, abs=1e-6)
    assert srgb_of_light(torch.tensor([light]))[0].item() == pytest.approx(srgb, abs=1e-6)


def test_both_kinds_agree_and_come_back():
    levels = np.arange(256) / 255.0
    light = linear_light(levels)
    np.testing.assert_allclose(linear_light(torch.from_numpy(levels)).numpy(), light, rtol=1e-12)
    np.testing.assert_allclose(srgb_of_light(light), levels, atol=1e-7)
    assert (np.diff(light) > 0).all()


def test_the_type_is_kept():
    assert linear_light(np.ones(2, np.float32)).dtype == srgb_of_light(np.ones(2, np.float32)).dtype == np.float32
