"""FLIP against the authors' program, against the definition with two-dimensional kernels, and in closed form."""

import math

import numpy as np
import pytest
from scipy.ndimage import correlate
from skimage.color import rgb2xyz, xyz2lab

from pipeline.metrics.flip import flip_map

WHITE_XYZ = rgb2xyz(np.ones(3))


@pytest.fixture
def pair() -> tuple[np.ndarray, np.ndarray]:
    """A colour pattern, and the same pattern shifted by three pixels with a red square."""
    rows, columns = np.mgrid[0:48, 0:64]
    pattern = np.stack([columns / 63, rows / 47, 0.5 + 0.5 * np.sin(columns / 5.0)], axis=2)
    image = np.rint(255 * pattern).astype(np.uint8)
    moved = np.roll(image, 3, axis=1)
    moved[10:20, 30:40] = [255, 0, 0]
    return moved, image


def flat(colour: list[int]) -> np.ndarray:
    return np.full((30, 30, 3), colour, dtype=np.uint8)


def reference_flip(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The equations of the paper, with colour conversions of scikit-image and two-dimensional filter kernels."""
    pixels_per_degree = 0.7 * 3840 / 0.7 * np.pi / 180
    prepared = [_prepare(image, pixels_per_degree) for image in (a, b)]
    (lab_a, edge_a, point_a), (lab_b, edge_b, point_b) = prepared
    green, blue = (_hunt(np.array(colour)) for colour in ([0.0, 1.0, 0.0], [0.0, 0.0, 1.0]))
    error, largest = _hyab(lab_a, lab_b) ** 0.7, _hyab(green, blue) ** 0.7
    low = 0.95 * error / (0.4 * largest)
    high = 0.95 + 0.05 * (error - 0.4 * largest) / (0.6 * largest)
    colour = np.where(error < 0.4 * largest, low, high)
    feature = np.sqrt(np.maximum(abs(edge_a - edge_b), abs(point_a - point_b)) / math.sqrt(2))
    return colour ** (1 - feature)


def _prepare(image: np.ndarray, pixels_per_degree: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    xyz = rgb2xyz(image) / WHITE_XYZ
    opponent = [116 * xyz[..., 1] - 16, 500 * (xyz[..., 0] - xyz[..., 1]), 200 * (xyz[..., 1] - xyz[..., 2])]
    radius = math.ceil(3 * math.sqrt(0.04 / (2 * math.pi**2)) * pixels_per_degree)
    x, y = np.meshgrid(np.arange(-radius, radius + 1), np.arange(-radius, radius + 1))
    squared = (x**2 + y**2) / pixels_per_degree**2
    for channel, gaussians in enumerate((((1, 0.0047),), ((1, 0.0053),), ((34.1, 0.04), (13.5, 0.025)))):
        kernel = sum(a * math.sqrt(math.pi / b) * np.exp(-(math.pi**2) * squared / b) for a, b in gaussians)
        opponent[channel] = correlate(opponent[channel], kernel / kernel.sum(), mode="nearest")
    blurred_y = (opponent[0] + 16) / 116
    blurred = np.stack([blurred_y + opponent[1] / 500, blurred_y, blurred_y - opponent[2] / 200], axis=2) * WHITE_XYZ
    linear = np.clip(blurred @ np.linalg.inv(_linear_to_xyz()).T, 0, 1)
    deviation = 0.5 * 0.082 * pixels_per_degree
    radius = math.ceil(3 * deviation)
    x, y = np.meshgrid(np.arange(-radius, radius + 1), np.arange(-radius, radius + 1))
    gauss = np.exp(-(x**2 + y**2) / (2 * deviation**2))
    strengths = []
    for kernel in (-x * gauss, (x**2 / deviation**2 - 1) * gauss):
        balanced = np.where(kernel < 0, -kernel / kernel[kernel < 0].sum(), kernel / kernel[kernel > 0].sum())
        responses = [correlate(xyz[..., 1], turned, mode="nearest") for turned in (balanced, balanced.T)]
        strengths.append(np.hypot(*responses))
    return _hunt(linear), strengths[0], strengths[1]


def _linear_to_xyz() -> np.ndarray:
    """scikit-image converts sRGB; the primaries are the same in linear RGB."""
    return np.stack([rgb2xyz(primary) for primary in np.eye(3)], axis=1)


def _hunt(linear: np.ndarray) -> np.ndarray:
    lab = xyz2lab(linear @ _linear_to_xyz().T)
    return np.concatenate([lab[..., :1], 0.01 * lab[..., :1] * lab[..., 1:]], axis=-1)


def _hyab(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return abs(a - b)[..., 0] + np.linalg.norm((a - b)[..., 1:], axis=-1)


def test_agrees_with_the_definition(pair: tuple[np.ndarray, np.ndarray]):
    # scikit-image rounds the primaries to six digits, and its white has x = 0.95047
    assert np.allclose(flip_map(*pair), reference_flip(*pair), atol=2e-3)


def test_agrees_with_the_authors_program(pair: tuple[np.ndarray, np.ndarray]):
    """Values of flip-evaluator 1.7 for the same images: LDR, default viewing distance."""
    differences = flip_map(*pair)
    assert differences.mean() == pytest.approx(0.4373817, abs=1e-5)
    assert differences[15, 35] == pytest.approx(0.9235482, abs=1e-4)
    assert differences[47, 63] == pytest.approx(0.4982262, abs=1e-4)
    assert flip_map(np.full_like(pair[1], 255), pair[1]).mean() == pytest.approx(0.9562674, abs=1e-4)


def test_closed_forms():
    assert flip_map(flat([0, 255, 0]), flat([0, 0, 255])) == pytest.approx(1.0)  # the largest possible difference
    largest = float(_hyab(_hunt(np.array([0.0, 1.0, 0.0])), _hunt(np.array([0.0, 0.0, 1.0])))) ** 0.7
    expected = 0.95 + 0.05 * (100**0.7 - 0.4 * largest) / (0.6 * largest)  # lightness differs by 100, chroma is equal
    assert flip_map(flat([0, 0, 0]), flat([255, 255, 255])) == pytest.approx(expected, abs=1e-4)


def test_equal_images_have_no_error_and_the_metric_is_symmetric(pair: tuple[np.ndarray, np.ndarray]):
    assert flip_map(pair[0], pair[0]).max() == 0.0
    assert np.allclose(flip_map(*pair), flip_map(*pair[::-1]))


def test_a_new_edge_is_worse_than_the_same_change_of_the_whole_image():
    image = flat([120, 120, 120])
    uniform, edge = flat([124, 124, 124]), image.copy()
    edge[:, 15] = [124, 124, 124]
    assert (
        flip_map(edge, image)[15, 15] > 0.5 * flip_map(uniform, image)[15, 15]
    )  # although the contrast sensitivity filter blurs it
    assert flip_map(edge, image)[:, :4].max() < 0.01
