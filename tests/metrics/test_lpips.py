"""LPIPS with random weights against the definition written with loops."""

import math

import numpy as np
import pytest
import torch
from scipy.signal import correlate

from pipeline.metrics.lpips import lpips
from tests.metrics.narrow_alexnet import KERNELS, narrow_alexnet


@pytest.fixture
def weights(rng: np.random.Generator) -> dict[str, torch.Tensor]:
    return narrow_alexnet(rng)


def reference_features(image: np.ndarray, weights: dict[str, torch.Tensor]) -> list[np.ndarray]:
    values = np.moveaxis(image / 255 * 2 - 1, 2, 0)
    values = (values - np.array([-0.030, -0.088, -0.188])[:, None, None]) / np.array([0.458, 0.448, 0.450])[
        :, None, None
    ]
    layers = []
    for layer, (name, _, stride, padding) in enumerate(KERNELS):
        if layer in (1, 2):
            rows, columns = ((size - 3) // 2 + 1 for size in values.shape[1:])
            windows = [[values[:, 2 * r : 2 * r + 3, 2 * c : 2 * c + 3] for c in range(columns)] for r in range(rows)]
            values = np.array([[window.max(axis=(1, 2)) for window in row] for row in windows]).transpose(2, 0, 1)
        padded = np.pad(values, ((0, 0), (padding, padding), (padding, padding)))
        kernels = weights[f"features.{name}.weight"].numpy().astype(float)
        biases = weights[f"features.{name}.bias"].numpy()
        values = np.stack(
            [correlate(padded, kernel, mode="valid")[0] + bias for kernel, bias in zip(kernels, biases, strict=True)]
        )[:, ::stride, ::stride]
        values = np.maximum(values, 0)
        layers.append(values / (np.sqrt((values**2).sum(axis=0)) + 1e-10))
    return layers


def test_agrees_with_the_definition(rng: np.random.Generator, weights: dict[str, torch.Tensor]):
    a, b = (rng.integers(0, 256, (67, 75, 3)).astype(np.uint8) for _ in range(2))
    expected = 0.0
    for layer, (x, y) in enumerate(zip(reference_features(a, weights), reference_features(b, weights), strict=True)):
        squared = (x - y) ** 2 * weights[f"lin{layer}.model.1.weight"].numpy()[0]
        expected += squared.sum(axis=0).mean()
    assert lpips(a, b, weights) == pytest.approx(expected, rel=1e-4)
    assert math.isclose(lpips(a, b, weights), lpips(b, a, weights), rel_tol=1e-6)


def test_equal_images_have_no_distance_and_small_images_are_refused(
    rng: np.random.Generator, weights: dict[str, torch.Tensor]
):
    image = rng.integers(0, 256, (63, 63, 3)).astype(np.uint8)
    assert lpips(image, image, weights) == 0.0
    with pytest.raises(ValueError, match="smaller than 63"):
        lpips(image[1:], image[1:], weights)
