"""Background plate of a static camera, and background subtraction. Pure functions."""

from __future__ import annotations

from functools import reduce
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Num, UInt8

# Minimum number of images that show a pixel without the person.
_MIN_OBSERVATIONS = 3
# Parts of what was seen at whose ends halves begin and end whose width is compared, and that width for a normal
# distribution.
_PARTS, _DEVIATIONS_OF_HALF = 8, 1.35
# Maximum difference from the plate caused by video noise and compression: levels of 255, and standard deviations.
_MAX_PLATE_DIFFERENCE_LEVELS, _MAX_PLATE_DEVIATIONS = 15.0, 2.0
# Smallest share of the difference inside at which a pixel of the rim is covered as much: less may be a halo of
# sharpening or of the codec.
_MIN_RIM_COVERAGE = 0.5
# Noise of plate and image beside the person, levels: at least rounding, a factor for what compression adds near the
# person, and the stride of the pixels that it is measured on.
_MIN_NOISE_LEVELS, _NOISE_FACTOR, _NOISE_STRIDE = 1.2, 2.0, 3
# Squared distance, in standard deviations, beyond which a colour is no less likely to be that of the plate.
_MAX_SQUARED_DISTANCE = 60.0
# Minimum ratio of shadowed to unshadowed colour.
_MIN_SHADOW_RATIO = 0.4
# Above this changed fraction of the background, the camera or the light has moved.
_MAX_CHANGED_FRACTION = 0.05


class BackgroundPlate(NamedTuple):
    """The scene without the person; undefined where `known` is false.

    deviation: standard deviation of what was seen, levels, from its narrowest half (Rousseeuw and Leroy, "A
    robust scale estimator based on the shortest half", 1988): leaves move, light flickers.
    """

    colour: UInt8[np.ndarray, "h w 3"]
    known: Bool[np.ndarray, "h w"]
    deviation: UInt8[np.ndarray, "h w"]

    def window(self, rows: slice, columns: slice) -> BackgroundPlate:
        """Return a crop of the plate."""
        return BackgroundPlate(*(part[rows, columns] for part in self))


def estimate_background_plate(
    images: UInt8[np.ndarray, "t h w 3"], person_masks: Bool[np.ndarray, "t h w"]
) -> BackgroundPlate:
    """Return the median over time, per pixel and channel, of the images that do not show the person there, and how much
    they differ.

    images: overwritten (sorted in place), because the array is large.
    person_masks: dilated masks; misses are tolerated in less than half of the images.
    """
    # The indices of the masked pixels of all images at once would need more memory than the images.
    for image, person in zip(images, person_masks, strict=True):
        image[person] = 255
    images.sort(axis=0)
    count = len(images) - person_masks.sum(axis=0)
    last = np.maximum(count - 1, 0)

    def quantile(share: float) -> UInt8[np.ndarray, "h w 3"]:
        index = np.floor(share * last).astype(np.intp)
        return np.take_along_axis(images, index[None, ..., None], axis=0)[0]

    quantiles, half = [quantile(part / _PARTS) for part in range(_PARTS + 1)], _PARTS // 2
    halves = [largest_difference(*ends) for ends in zip(quantiles, quantiles[half:], strict=False)]
    deviation = (reduce(np.minimum, halves) / _DEVIATIONS_OF_HALF).astype(np.uint8)
    return BackgroundPlate(quantiles[half], count >= _MIN_OBSERVATIONS, deviation)


class PlateComparison(NamedTuple):
    """An image beside the plate of its recording.

    known: where the plate is. difference: of the colours, levels, 0 where the plate or a shadow on it explains it.
    log_density: logarithm of the density (without the factor of 2 pi) of the colour in [0, 1] if it shows the plate.
    is_near: where this density is not at its smallest.
    """

    known: Bool[np.ndarray, "h w"]
    difference: UInt8[np.ndarray, "h w"]
    log_density: Float[np.ndarray, "h w"]
    is_near: Bool[np.ndarray, "h w"]


def compare_with_plate(
    rgb: UInt8[np.ndarray, "h w 3"], plate: BackgroundPlate, dilated_person: Bool[np.ndarray, "h w"]
) -> PlateComparison | None:
    """Compare an image with the plate; a shadow scales the colour of the plate.

    Returns None if the scene outside `dilated_person` has changed as well or is not known: the camera has moved.
    """
    changed = _differs_from_plate(rgb, plate)
    difference = cv2.absdiff(rgb, plate.colour)
    away = (plate.known & ~dilated_person)[::_NOISE_STRIDE, ::_NOISE_STRIDE]
    noise_levels = difference[::_NOISE_STRIDE, ::_NOISE_STRIDE][away]
    share = _changed_background_fraction(changed, plate, dilated_person)
    if not len(noise_levels) or share > _MAX_CHANGED_FRACTION:
        return None
    deviations = np.maximum(1.4826 * np.median(noise_levels, axis=0), _MIN_NOISE_LEVELS)
    noise = _NOISE_FACTOR * np.maximum(plate.deviation, np.float32(deviations.mean()))
    squared = cv2.transform(np.square(difference, dtype=np.float32), np.ones((1, 3), np.float32)) / np.square(noise)
    is_near = plate.known & (squared < _MAX_SQUARED_DISTANCE)
    log_density = -0.5 * np.minimum(squared, np.float32(_MAX_SQUARED_DISTANCE)) - 3.0 * np.log(noise / 255.0)
    unexplained = np.where(changed, largest_difference(rgb, plate.colour), np.uint8(0))
    return PlateComparison(plate.known, unexplained, log_density, is_near)


def least_alpha(difference: UInt8[np.ndarray, "h w"], rim_px: int) -> Float[np.ndarray, "h w"]:
    """Return a lower bound of alpha in [0, 1] from the `difference` of a `PlateComparison`.

    The person covers a pixel if all pixels up to `rim_px` away differ. In sharp images (`rim_px` 1) others are covered
    by their share of the difference inside, if that is large enough; blurred outlines would get thicker.
    """

    def window(radius_px: int) -> UInt8[np.ndarray, "k k"]:
        return np.ones((2 * radius_px + 1, 2 * radius_px + 1), np.uint8)

    covered = cv2.erode((difference > 0).astype(np.uint8), window(rim_px))
    if rim_px > 1:
        return covered.astype(np.float32)
    inside = cv2.dilate(covered * difference, window(2)).astype(np.float32)
    share = np.minimum(difference / np.maximum(inside, np.float32(1.0)), np.float32(1.0))
    rim = np.where((inside > 0) & (share >= _MIN_RIM_COVERAGE), share, np.float32(0.0))
    return np.maximum(covered, rim)


def detect_scene_changes(
    images: UInt8[np.ndarray, "t h w 3"], person_masks: Bool[np.ndarray, "t h w"]
) -> Bool[np.ndarray, "t"]:
    """Return which images show another background than the others: the camera or the light has moved.

    person_masks: dilated masks of the person.
    """
    plate = estimate_background_plate(images.copy(), person_masks)
    pairs = zip(images, person_masks, strict=True)
    return np.array(
        [
            _changed_background_fraction(_differs_from_plate(image, plate), plate, person) > _MAX_CHANGED_FRACTION
            for image, person in pairs
        ]
    )


def _differs_from_plate(rgb: UInt8[np.ndarray, "h w 3"], plate: BackgroundPlate) -> Bool[np.ndarray, "h w"]:
    """Return the pixels whose colour neither the plate nor a shadow on it explains."""
    limit = np.maximum(_MAX_PLATE_DEVIATIONS * plate.deviation, np.float32(_MAX_PLATE_DIFFERENCE_LEVELS))
    changed = plate.known & (largest_difference(rgb, plate.colour) > limit)
    pixels = np.nonzero(changed)
    image, colour = rgb[pixels].astype(np.float32), plate.colour[pixels].astype(np.float32)
    shading_ratio = (image * colour).sum(axis=-1) / np.maximum((colour * colour).sum(axis=-1), 1.0)
    shaded = colour * np.clip(shading_ratio, _MIN_SHADOW_RATIO, 1.0)[:, None]
    changed[pixels] = np.abs(image - shaded).max(axis=-1) > limit[pixels]
    return changed


def largest_difference(first: Num[np.ndarray, "h w 3"], second: Num[np.ndarray, "h w 3"]) -> Num[np.ndarray, "h w"]:
    """Return the largest absolute difference of a channel at each pixel; the images have one type."""
    return reduce(cv2.max, cv2.split(cv2.absdiff(first, second)))


def _changed_background_fraction(
    changed: Bool[np.ndarray, "h w"], plate: BackgroundPlate, dilated_person: Bool[np.ndarray, "h w"]
) -> float:
    """Return the changed fraction of the known background away from the person; nan if none is known."""
    away = plate.known & ~dilated_person
    return float(changed[away].mean()) if away.any() else float("nan")
