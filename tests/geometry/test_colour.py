"""The transfer function of sRGB: values of the standard, both directions, arrays and tensors."""

import numpy as np
import pytest
import torch

from pipeline.geometry.colour import linear_to_srgb, srgb_to_linear


@pytest.mark.parametrize(
    ("srgb", "linear"), [(0.0, 0.0), (0.02, 0.02 / 12.92), (0.5, 0.214041), (0.735357, 0.5), (1, 1)]
)
def test_known_points(srgb, linear):
    assert srgb_to_linear(np.array([srgb]))[0] == pytest.approx(linear, abs=1e-6)
    assert linear_to_srgb(torch.tensor([linear]))[0].item() == pytest.approx(srgb, abs=1e-6)


def test_arrays_and_tensors_agree_and_the_inverse_restores_the_values():
    levels = np.arange(256) / 255.0
    linear = srgb_to_linear(levels)
    np.testing.assert_allclose(srgb_to_linear(torch.from_numpy(levels)).numpy(), linear, rtol=1e-12)
    np.testing.assert_allclose(linear_to_srgb(linear), levels, atol=1e-7)
    assert (np.diff(linear) > 0).all()


def test_the_dtype_is_kept():
    assert srgb_to_linear(np.ones(2, np.float32)).dtype == linear_to_srgb(np.ones(2, np.float32)).dtype == np.float32
