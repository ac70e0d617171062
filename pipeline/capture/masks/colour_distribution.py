"""Gaussian distributions of the colours around each point of a coarse grid. Pure functions.

Colours are in [0, 1]. Matrices are symmetric, in the order xx, xy, xz, yy, yz, zz.
"""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float

# Minimum standard deviation of a colour distribution (of 1): rounding. Colours are averaged over cells first, so video
# noise is small, and a white coat in front of a white wall needs every level.
_COLOUR_NOISE = 1.0 / 255.0
# The same for a single pixel, which has the noise of the video.
_PIXEL_NOISE = 3.0 / 255.0
# A wider window (factor) contributes with a small weight; it has the only samples in a gap between arm and torso.
_WIDE_WINDOW_FACTOR, _WIDE_WINDOW_WEIGHT = 8, 0.01
# Minimum mean weight of a colour distribution: a tenth of the wide window.
MIN_SAMPLE_WEIGHT = 1e-3
# Squared Mahalanobis distance beyond which a colour is no less likely: shapes and lights that the window did not show.
_MAX_SQUARED_DISTANCE = 30.0


class ColourDistribution(NamedTuple):
    """Colour statistics around each grid point: mean weight, mean, covariance (xx, xy, xz, yy, yz, zz)."""

    weight: Float[np.ndarray, "h w"]
    mean: Float[np.ndarray, "h w 3"]
    covariance: Float[np.ndarray, "6 h w"]


def local_colour_distribution(
    image: Float[np.ndarray, "h w 3"], weight: Float[np.ndarray, "h w"], small: tuple[int, int], radius: int
) -> ColourDistribution:
    """Return weighted mean and covariance of colours in a window around each point of a coarse grid, plus a wider
    window.

    small: columns and rows of the grid. radius: half of the window in grid points. Colours are averaged over the grid's
    cells before products are formed: texture finer than a cell does not count as variance.
    """
    weight = weight.astype(np.float32)
    share = cv2.resize(weight, small, interpolation=cv2.INTER_AREA)
    weighted = cv2.resize(cv2.multiply(image, cv2.merge([weight] * 3)), small, interpolation=cv2.INTER_AREA)
    colour = weighted / (share[..., None] + 1e-6)

    def box_filter(values: np.ndarray) -> np.ndarray:
        near, far = (
            cv2.blur(values, (2 * half_width + 1, 2 * half_width + 1), borderType=cv2.BORDER_CONSTANT)
            for half_width in (radius, _WIDE_WINDOW_FACTOR * radius)
        )
        return near + np.float32(_WIDE_WINDOW_WEIGHT) * far

    total = box_filter(share)
    scale = 1.0 / (total + 1e-6)
    mean = box_filter(weighted) * scale[..., None]
    sums, colours, means = cv2.split(weighted), cv2.split(colour), cv2.split(mean)
    covariance = [
        box_filter(cv2.multiply(sums[i], colours[j])) * scale - means[i] * means[j]
        for i in range(3)
        for j in range(i, 3)
    ]
    return ColourDistribution(total, mean, np.stack(covariance))


def fisher_discriminant(
    person: ColourDistribution, background: ColourDistribution
) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """Return direction, offset and certainty of Fisher's linear discriminant of two colour distributions per grid
    point.

    direction . I - offset is 0 for I = B and 1 for I = F. With S the sum of both covariances and d = F - B: w = S^-1 d,
    direction = w / w.d, offset = direction . B, certainty = w.d, the squared Mahalanobis distance of the means (0
    where a distribution is empty).
    """
    pooled = (person.covariance + background.covariance).astype(np.float64)
    pooled[[0, 3, 5]] += _COLOUR_NOISE**2
    difference = (person.mean - background.mean).astype(np.float64)
    w = np.moveaxis(solve_symmetric(pooled, np.moveaxis(difference, -1, 0)), 0, -1)
    certainty = (w * difference).sum(axis=-1)
    direction = w / np.maximum(certainty, 1e-6)[..., None]
    offset = (direction * background.mean).sum(axis=-1)
    certainty = np.where(np.minimum(person.weight, background.weight) > MIN_SAMPLE_WEIGHT, certainty, 0.0)
    return direction.astype(np.float32), offset.astype(np.float32), certainty.astype(np.float32)


def log_density(
    image: Float[np.ndarray, "h w 3"], distribution: ColourDistribution, pixels: tuple[np.ndarray, np.ndarray]
) -> Float[np.ndarray, "n"]:
    """Return the logarithm of the density (without the factor of 2 pi) of the colours of some pixels, each in the
    distribution around the nearest point of the grid; infinite where that has no samples.

    pixels: rows and columns.
    """
    covariance = distribution.covariance.astype(np.float64)
    covariance[[0, 3, 5]] += _PIXEL_NOISE**2
    cofactors = _cofactors(covariance)
    determinant = (covariance[:3] * cofactors[:3]).sum(axis=0)
    precision = (cofactors / determinant).astype(np.float32)
    log_peak = np.where(distribution.weight > MIN_SAMPLE_WEIGHT, -0.5 * np.log(determinant), np.inf)
    point = tuple(
        index * count // side for index, count, side in zip(pixels, determinant.shape, image.shape[:2], strict=True)
    )
    deviation = (image[pixels] - distribution.mean[point]).T
    squared_distance = (deviation * _multiply_symmetric(precision[:, *point], deviation)).sum(axis=0)
    return log_peak[point].astype(np.float32) - 0.5 * np.minimum(squared_distance, np.float32(_MAX_SQUARED_DISTANCE))


def solve_symmetric(
    matrix: Float[np.ndarray, "6 h w"], right: Float[np.ndarray, "3 h w"]
) -> Float[np.ndarray, "3 h w"]:
    """Solve symmetric systems by their adjugate; LAPACK takes 15 times as long for 3 x 3."""
    cofactors = _cofactors(matrix)
    return _multiply_symmetric(cofactors, right) / (matrix[:3] * cofactors[:3]).sum(axis=0)


def _cofactors(matrix: Float[np.ndarray, "6 h w"]) -> Float[np.ndarray, "6 h w"]:
    """Return the adjugates of symmetric matrices, which are symmetric as well."""
    xx, xy, xz, yy, yz, zz = matrix
    return np.stack(
        [
            yy * zz - yz * yz,
            xz * yz - xy * zz,
            xy * yz - xz * yy,
            xx * zz - xz * xz,
            xy * xz - xx * yz,
            xx * yy - xy * xy,
        ]
    )


def _multiply_symmetric(
    matrix: Float[np.ndarray, "6 *n"], vector: Float[np.ndarray, "3 *n"]
) -> Float[np.ndarray, "3 *n"]:
    xx, xy, xz, yy, yz, zz = matrix
    x, y, z = vector
    return np.stack([xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z])
