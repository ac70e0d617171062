"""Straight alpha against closed forms."""

import numpy as np
import pytest

from pipeline.geometry.alpha import unpremultiply_to_uint8


@pytest.mark.parametrize(
    ("premultiplied", "expected"),
    [([0.2, 0.1, 0.3, 0.5], [102, 51, 153, 128]), ([0.2, 0.1, 0.0, 0.5], [102, 51, 0, 128])],
)
def test_straight_colour_is_the_premultiplied_colour_divided_by_alpha(premultiplied, expected):
    image = np.array([[premultiplied, [0.0, 0.0, 0.0, 0.0], [1.0, 1.0, 1.0, 1.0]]], dtype=np.float32)
    assert unpremultiply_to_uint8(image).tolist() == [[expected, [0, 0, 0, 0], [255, 255, 255, 255]]]
