"""FLIP, the difference that a person perceives when alternating between two images (low dynamic range).

Reference: Andersson et al., "FLIP: A Difference Evaluator for Alternating Images", HPG 2020; the constants have the
names of that paper. The default viewing distance is the authors': 0.7 m from a display 0.7 m and 3840 px wide, which
gives 67 pixels per degree.

The authors' package `flip-evaluator` 1.7 gives the same values (largest difference 5e-6 per pixel) in 2.5 times the
time on one thread, so this implementation is kept; the test compares with the values of that package.
"""

import math

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from pipeline.geometry.colour import srgb_to_linear

PIXELS_PER_DEGREE = 3840.0 * math.pi / 180.0
QC, QF, PC, PT = 0.7, 0.5, 0.4, 0.95
FEATURE_WIDTH_DEG = 0.082

CONTRAST_GAUSSIANS: tuple[tuple[tuple[float, float], ...], ...] = (
    ((1.0, 0.0047),),
    ((1.0, 0.0053),),
    ((34.1, 0.04), (13.5, 0.025)),
)
"""(a, b) of the Gaussians of each opponent channel's contrast sensitivity: achromatic, red-green, blue-yellow."""

# Single precision, as the authors' package: half the time of doubles.
_LINEAR_RGB_TO_XYZ = np.array(
    [
        [10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794],
        [2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897],
        [1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382],
    ],
    dtype=np.float32,
)
_WHITE_XYZ = _LINEAR_RGB_TO_XYZ.sum(axis=1)


def flip_map(
    render: UInt8[np.ndarray, "h w 3"], image: UInt8[np.ndarray, "h w 3"], pixels_per_degree: float = PIXELS_PER_DEGREE
) -> Float[np.ndarray, "h w"]:
    """Return the perceived error of each pixel in [0, 1]; 0 for equal images, symmetric in the two sRGB images."""
    ycxcz = [_linear_rgb_to_ycxcz(srgb_to_linear(srgb / np.float32(255.0))) for srgb in (render, image)]
    filtered = [_hunt_lab(_filter_by_csf(channels, pixels_per_degree)) for channels in ycxcz]
    colour = _redistribute_errors(_hyab(*filtered) ** QC)
    brightness = [(channels[..., 0] + 16.0) / 116.0 for channels in ycxcz]
    differences = []
    for point in (False, True):
        strengths = [_feature_strength(channel, point, pixels_per_degree) for channel in brightness]
        differences.append(np.abs(strengths[0] - strengths[1]))
    feature = (np.maximum(*differences) / math.sqrt(2.0)) ** QF
    return colour ** (1.0 - np.minimum(feature, 1.0))


def _linear_rgb_to_ycxcz(linear: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Convert linear RGB to YyCxCz, a linear opponent colour space."""
    x, y, z = np.moveaxis(linear @ _LINEAR_RGB_TO_XYZ.T / _WHITE_XYZ, -1, 0)
    return np.stack([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)], axis=-1)


def _ycxcz_to_linear_rgb(ycxcz: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Convert YyCxCz to linear RGB, the inverse of `_linear_rgb_to_ycxcz`."""
    y = (ycxcz[..., 0] + 16.0) / 116.0
    xyz = np.stack([y + ycxcz[..., 1] / 500.0, y, y - ycxcz[..., 2] / 200.0], axis=-1) * _WHITE_XYZ
    return xyz @ np.linalg.inv(_LINEAR_RGB_TO_XYZ).T


def _filter_by_csf(ycxcz: Float[np.ndarray, "h w 3"], pixels_per_degree: float) -> Float[np.ndarray, "h w 3"]:
    """Filter each channel with its contrast sensitivity function; the result is linear RGB in [0, 1]."""
    widest = max(b for gaussians in CONTRAST_GAUSSIANS for _, b in gaussians)
    radius = math.ceil(3.0 * math.sqrt(widest / (2.0 * math.pi**2)) * pixels_per_degree)
    squared_deg = (np.arange(-radius, radius + 1) / pixels_per_degree) ** 2
    channels = []
    for channel, gaussians in enumerate(CONTRAST_GAUSSIANS):
        rows = [np.exp(-(math.pi**2) * squared_deg / b) for _, b in gaussians]
        masses = [a * math.sqrt(math.pi / b) * row.sum() ** 2 for (a, b), row in zip(gaussians, rows, strict=True)]
        parts = [
            mass / sum(masses) * _filter_separable(ycxcz[..., channel], row / row.sum(), row / row.sum())
            for mass, row in zip(masses, rows, strict=True)
        ]
        channels.append(np.sum(parts, axis=0))
    return np.clip(_ycxcz_to_linear_rgb(np.stack(channels, axis=-1)), 0.0, 1.0)


def _hunt_lab(linear: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Convert linear RGB to CIELAB with a chroma that grows with lightness (Hunt effect)."""
    ratio = linear @ _LINEAR_RGB_TO_XYZ.T / _WHITE_XYZ
    delta = 6.0 / 29.0
    x, y, z = np.moveaxis(np.where(ratio > delta**3, np.cbrt(ratio), ratio / (3.0 * delta**2) + 4.0 / 29.0), -1, 0)
    lightness = 116.0 * y - 16.0
    return np.stack([lightness, 0.01 * lightness * 500.0 * (x - y), 0.01 * lightness * 200.0 * (y - z)], axis=-1)


def _hyab(a: Float[np.ndarray, "*n 3"], b: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n"]:
    """Return the HyAB distance: absolute difference of lightness plus Euclidean distance of chroma."""
    difference = a - b
    return np.abs(difference[..., 0]) + np.hypot(difference[..., 1], difference[..., 2])


def _redistribute_errors(error: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Map errors to [0, 1]: errors up to PC of the largest possible error (green to blue) map to [0, PT]."""
    green, blue = (_hunt_lab(np.array([primary], np.float32)) for primary in ([0.0, 1.0, 0.0], [0.0, 0.0, 1.0]))
    largest = _hyab(green, blue).item() ** QC
    knee = PC * largest
    return np.where(error < knee, PT / knee * error, PT + (error - knee) / (largest - knee) * (1.0 - PT))


def _feature_strength(
    brightness: Float[np.ndarray, "h w"], point: bool, pixels_per_degree: float
) -> Float[np.ndarray, "h w"]:
    """Return the magnitude of the edge (or point) responses along rows and columns; each filter lobe sums to one."""
    deviation = 0.5 * FEATURE_WIDTH_DEG * pixels_per_degree
    offsets = np.arange(-math.ceil(3.0 * deviation), math.ceil(3.0 * deviation) + 1)
    across = np.exp(-(offsets**2) / (2.0 * deviation**2))
    along = (offsets**2 / deviation**2 - 1.0) * across if point else -offsets * across
    along = np.where(along > 0.0, along / along[along > 0.0].sum(), -along / along[along < 0.0].sum())
    across /= across.sum()
    return np.hypot(_filter_separable(brightness, along, across), _filter_separable(brightness, across, along))


def _filter_separable(
    channel: Float[np.ndarray, "h w"], rows: Float[np.ndarray, "k"], columns: Float[np.ndarray, "k"]
) -> Float[np.ndarray, "h w"]:
    """Correlate a channel with the outer product of `columns` and `rows`; border pixels are repeated."""
    return cv2.sepFilter2D(np.ascontiguousarray(channel), -1, rows, columns, borderType=cv2.BORDER_REPLICATE)
