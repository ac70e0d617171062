"""Straight alpha against closed forms."""

import numpy as np
import pytest

from pipeline.geometry.alpha import crop_empty_columns, premultiply_to_float, unpremultiply_to_uint8


@pytest.mark.parametrize(
    ("premultiplied", "expected"),
    [([0.2, 0.1, 0.3, 0.5], [102, 51, 153, 128]), ([0.2, 0.1, 0.0, 0.5], [102, 51, 0, 128])],
)
def test_straight_colour_is_the_premultiplied_colour_divided_by_alpha(premultiplied, expected):
    image = np.array([[premultiplied, [0.0, 0.0, 0.0, 0.0], [1.0, 1.0, 1.0, 1.0]]], dtype=np.float32)
    assert unpremultiply_to_uint8(image).tolist() == [[expected, [0, 0, 0, 0], [255, 255, 255, 255]]]


def test_premultiplied_colour_is_the_straight_one_times_alpha():
    straight = np.array([[[255, 51, 0, 51], [255, 255, 255, 0]]], dtype=np.uint8)
    assert np.allclose(premultiply_to_float(straight), [[[0.2, 0.04, 0.0, 0.2], [0.0, 0.0, 0.0, 0.0]]])
    image = np.random.default_rng(0).integers(0, 256, (5, 4, 4)).astype(np.uint8)
    image[..., 3] = np.maximum(image[..., 3], 128)
    assert np.abs(unpremultiply_to_uint8(premultiply_to_float(image)).astype(int) - image).max() <= 1


def test_columns_outside_the_visible_ones_are_removed():
    image = np.zeros((3, 7, 4), dtype=np.uint8)
    image[1, 2, 3], image[2, 4, 3] = 1, 255
    assert np.array_equal(crop_empty_columns(image), image[:, 2:5])
    assert crop_empty_columns(np.zeros_like(image)).shape == image.shape
