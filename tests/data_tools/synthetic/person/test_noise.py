"""Solid noise: deterministic, bounded, continuous and periodic."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from data_tools.synthetic.person.noise import ValueNoise

POINTS = np.random.default_rng(5).uniform(-2.0, 2.0, (500, 3)).astype(np.float32)


@settings(max_examples=10)
@given(seed=st.integers(0, 2**31 - 1))
def test_equal_seeds_give_equal_fields(seed: int) -> None:
    assert np.array_equal(ValueNoise(seed)(POINTS, 0.1), ValueNoise(seed)(POINTS, 0.1))
    assert not np.allclose(ValueNoise(seed)(POINTS, 0.1), ValueNoise(seed + 1)(POINTS, 0.1))


@pytest.mark.parametrize("order", [1, 3])
def test_values_are_bounded_and_centred(order: int) -> None:
    values = ValueNoise(1)(POINTS, 0.05, order=order)
    assert np.abs(values).max() < 1.5
    assert abs(values.mean()) < 0.1
    assert values.std() > 0.2


def test_field_is_periodic_and_continuous() -> None:
    """The values repeat after 32 cells, across the border of the lattice."""
    noise = ValueNoise(2)
    assert np.allclose(noise(POINTS, 0.1), noise(POINTS + np.float32(3.2), 0.1), atol=1e-3)
    across_border = np.array([[3.2 - 1e-5, 0.3, 0.4], [3.2 + 1e-5, 0.3, 0.4]], dtype=np.float32)
    below, above = noise(across_border, 0.1)
    assert below == pytest.approx(above, abs=1e-2)


def test_linear_between_lattice_points() -> None:
    ends = np.array([[0.1, 0.2, 0.3], [0.2, 0.2, 0.3]], dtype=np.float32)
    middle = ends.mean(axis=0, keepdims=True)
    noise = ValueNoise(3)
    assert noise(middle, 0.1)[0] == pytest.approx(noise(ends, 0.1).mean(), abs=1e-5)


def test_wavelengths_per_axis_stretch_the_field() -> None:
    stretched = POINTS * np.array([1.0, 4.0, 1.0], dtype=np.float32)
    assert np.allclose(ValueNoise(4)(stretched, (0.1, 0.4, 0.1)), ValueNoise(4)(POINTS, 0.1), atol=1e-4)


def test_fractal_stays_bounded() -> None:
    assert np.abs(ValueNoise(6).fractal(POINTS, 0.3, octaves=4)).max() <= 1.0
