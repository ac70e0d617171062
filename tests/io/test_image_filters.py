"""Resizing and hole filling against closed forms."""

import cv2
import numpy as np
import pytest

from pipeline.io.image import push_pull, resize

FILTERS = ("box", "triangle", "cubic", "catmull-rom", "lanczos3")


@pytest.mark.parametrize("filter_name", FILTERS)
@pytest.mark.parametrize("size", [(20, 14), (13, 9), (64, 64)])
def test_a_constant_image_stays_constant(filter_name, size):
    resized = resize(np.full((32, 40, 3), 0.3, np.float32), *size, filter_name)
    assert resized.shape == (size[1], size[0], 3)
    np.testing.assert_allclose(resized, 0.3, atol=1e-5)
    assert (resize(np.full((32, 40, 3), 77, np.uint8), *size, filter_name) == 77).all()


@pytest.mark.parametrize("filter_name", ["triangle", "cubic", "catmull-rom"])
@pytest.mark.parametrize("width_px", [32, 40, 100])
def test_a_ramp_stays_in_place(filter_name, width_px):
    """Pixel centres lie at + 0.5 in both grids; symmetric filters keep linear functions away from the border."""
    ramp = np.tile(((np.arange(64) + 0.5) / 64).astype(np.float32)[None, :, None], (64, 1, 1))
    resized = resize(ramp, width_px, 64, filter_name)[32, :, 0]
    inner = slice(width_px // 8, -width_px // 8)
    np.testing.assert_allclose(resized[inner], ((np.arange(width_px) + 0.5) / width_px)[inner], atol=2e-3)


@pytest.mark.parametrize("factor", [2, 3])
def test_box_averages_blocks_as_opencv_does(factor):
    pixels = np.random.default_rng(0).uniform(size=(6 * factor, 8 * factor, 3)).astype(np.float32)
    means = pixels.reshape(6, factor, 8, factor, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(resize(pixels, 8, 6, "box"), means, atol=1e-5)
    np.testing.assert_allclose(cv2.resize(pixels, (8, 6), interpolation=cv2.INTER_AREA), means, atol=1e-5)


def test_a_pattern_too_fine_for_the_new_grid_vanishes():
    """Wave of 3/4 cycles a new pixel: half of the area average's amplitude is an alias, little of Catmull-Rom's is."""
    wave = 0.5 + 0.4 * np.cos(2 * np.pi * 0.75 * (np.arange(512) + 0.5) / 2)
    pixels = np.tile(wave.astype(np.float32)[None, :, None], (16, 1, 1))
    left = np.sqrt(2.0) * resize(pixels, 256, 16)[8, 20:-20, 0].std() / 0.4
    assert left < 0.08
    area = np.sqrt(2.0) * cv2.resize(pixels, (256, 16), interpolation=cv2.INTER_AREA)[8, 20:-20].std() / 0.4
    assert area == pytest.approx(abs(np.cos(np.pi * 0.75 / 2)), rel=0.01)


def test_an_unknown_filter_is_an_error():
    with pytest.raises(ValueError, match="nonsense"):
        resize(np.zeros((4, 4, 3), np.uint8), 2, 2, "nonsense")


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("size", [(1, 1), (7, 5), (64, 33)])
def test_push_pull_keeps_what_is_known_and_stays_between_its_extremes(size, channels):
    random = np.random.default_rng(1)
    pixels = random.uniform(0.2, 0.8, (*size, channels)).astype(np.float32)
    known = random.uniform(size=size) < 0.2
    known[0, 0] = True
    filled = push_pull(np.where(known[..., None], pixels, np.float32(7.0)), known)
    np.testing.assert_array_equal(filled[known], pixels[known])
    assert np.all(filled >= pixels[known].min(axis=0) - 1e-4)
    assert np.all(filled <= pixels[known].max(axis=0) + 1e-4)


def test_push_pull_of_nothing_is_black():
    assert not push_pull(np.ones((8, 8, 2), np.float32), np.zeros((8, 8), dtype=bool)).any()
