"""The palette of a picture: distributions of colours with known optimal transport, and what must not change."""

import cv2
import numpy as np
import pytest

from pipeline.texture.palette import MAX_LIGHTNESS_SLOPE, move_lightness, transfer_palette, transport_colours


def test_the_transport_between_normal_distributions_is_the_linear_one() -> None:
    """Closed form of Monge's map: x -> m2 + S1^-1/2 (S1^1/2 S2 S1^1/2)^1/2 S1^-1/2 (x - m1)."""
    random = np.random.default_rng(0)
    first = np.diag([100.0, 25.0, 9.0])
    turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
    second = turn @ np.diag([80.0, 30.0, 12.0]) @ turn.T
    colours = random.multivariate_normal([50, 0, 0], first, 20_000)
    target = random.multivariate_normal([60, 20, -10], second, 20_000)
    moved = transport_colours(colours, target, random)
    np.testing.assert_allclose(moved.mean(axis=0), [60, 20, -10], atol=0.4)
    np.testing.assert_allclose(np.cov(moved.T), second, atol=3.0)
    root = np.sqrt(first)
    values, vectors = np.linalg.eigh(root @ second @ root)
    middle = vectors @ np.diag(np.sqrt(values)) @ vectors.T
    monge = [60, 20, -10] + (colours - [50, 0, 0]) @ (np.linalg.inv(root) @ middle @ np.linalg.inv(root)).T
    cost = [np.mean(np.sum((end - colours) ** 2, axis=1)) for end in (moved, monge)]
    assert cost[0] < 1.1 * cost[1]  # sliced transport is not optimal in three dimensions, but near


def test_lighter_stays_lighter() -> None:
    random = np.random.default_rng(1)
    lightness = np.sort(random.uniform(20.0, 60.0, 5000))
    moved = move_lightness(lightness, np.concatenate([random.normal(15, 3, 5000), random.normal(85, 3, 5000)]))
    steps = np.diff(moved)
    assert steps.min() >= 0.0
    assert (steps / np.maximum(np.diff(lightness), 1e-9)).max() < MAX_LIGHTNESS_SLOPE + 1e-6
    np.testing.assert_allclose(move_lightness(lightness, lightness), lightness, atol=0.2)


def test_colours_of_the_picture_on_the_drawing_of_the_map() -> None:
    random = np.random.default_rng(2)
    drawing = np.kron(random.uniform(0.25, 0.75, size=(8, 8)), np.ones((16, 16))).astype(np.float32)
    image = np.repeat(drawing[..., None], 3, axis=2)
    image[..., 0] *= 0.9
    look = np.stack([random.uniform(0.0, 0.3, (90, 50)), random.uniform(0.1, 0.4, (90, 50)), np.full((90, 50), 0.8)], 2)
    covered = np.ones((128, 128), bool)
    covered[:, 100:] = False
    styled = transfer_palette(image, covered, look.astype(np.float32))
    np.testing.assert_array_equal(styled[~covered], image[~covered])
    before, after, wanted = (
        cv2.cvtColor(np.ascontiguousarray(pixels, np.float32), cv2.COLOR_RGB2LAB) for pixels in (image, styled, look)
    )
    inside = np.zeros_like(covered)
    inside[8:120, 8:90] = True
    assert np.median(after[inside][:, 2]) == pytest.approx(np.median(wanted[..., 2]), abs=12.0)
    assert abs(np.median(before[inside][:, 2]) - np.median(wanted[..., 2])) > 40.0
    assert np.corrcoef(before[inside][:, 0], after[inside][:, 0])[0, 1] > 0.9


def test_the_own_palette_changes_little() -> None:
    image = np.random.default_rng(3).uniform(0.2, 0.8, size=(64, 64, 3)).astype(np.float32)
    styled = transfer_palette(image, np.ones((64, 64), bool), image)
    assert np.abs(styled - image).mean() < 0.01


def test_one_colour_takes_one_colour() -> None:
    """A plain map has no distribution to speak of: it takes a middle colour of the picture."""
    plain, look = np.full((32, 32, 3), 0.5, np.float32), np.full((8, 8, 3), 0.5, np.float32)
    look[..., 0] = 0.9
    styled = transfer_palette(plain, np.ones((32, 32), bool), look)
    assert np.isfinite(styled).all()
    assert styled[16, 16, 0] > styled[16, 16, 2] + 0.2
