"""Background plate of a static camera, and background subtraction. Pure functions."""

from __future__ import annotations

from functools import reduce
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Num, UInt8

# Minimum number of images that show a pixel without the person.
_MIN_OBSERVATIONS = 3
# Maximum difference from the plate caused by video noise and compression, levels of 255.
_MAX_PLATE_DIFFERENCE_LEVELS = 15.0
# Changed pixels closer than this to an unchanged one may be covered partly: half of the width of a blurred outline.
_EROSION_RADIUS_PX = 2
# Minimum ratio of shadowed to unshadowed colour.
_MIN_SHADOW_RATIO = 0.4
# Above this changed fraction of the background, the camera or the light has moved.
_MAX_CHANGED_FRACTION = 0.05


class BackgroundPlate(NamedTuple):
    """The scene without the person. `colour` is undefined where `known` is false."""

    colour: UInt8[np.ndarray, "h w 3"]
    known: Bool[np.ndarray, "h w"]

    def window(self, rows: slice, columns: slice) -> BackgroundPlate:
        """Return a crop of the plate."""
        return BackgroundPlate(self.colour[rows, columns], self.known[rows, columns])


def estimate_background_plate(
    images: UInt8[np.ndarray, "t h w 3"], person_masks: Bool[np.ndarray, "t h w"]
) -> BackgroundPlate:
    """Return the median over time, per pixel and channel, of the images that do not show the person there.

    images: overwritten (sorted in place), because the array is large.
    person_masks: dilated masks; misses are tolerated in less than half of the images.
    """
    # The indices of the masked pixels of all images at once would need more memory than the images.
    for image, person in zip(images, person_masks, strict=True):
        image[person] = 255
    images.sort(axis=0)
    count = len(images) - person_masks.sum(axis=0)
    middle = np.maximum(count - 1, 0) // 2
    colour = np.take_along_axis(images, middle[None, ..., None], axis=0)[0]
    return BackgroundPlate(colour, count >= _MIN_OBSERVATIONS)


def subtract_background(
    rgb: UInt8[np.ndarray, "h w 3"], plate: BackgroundPlate, dilated_person: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Return the pixels that neither the plate nor a shadow on it explains, eroded by the width of a blurred outline.

    A shadow scales the colour of the plate. Returns no pixel if the scene outside `dilated_person` has changed as well,
    because then the camera has moved.
    """
    changed = _differs_from_plate(rgb, plate)
    share = _changed_background_fraction(changed, plate, dilated_person)
    if np.isnan(share) or share > _MAX_CHANGED_FRACTION:
        return np.zeros_like(changed)
    return (
        cv2.erode(changed.astype(np.uint8), np.ones((2 * _EROSION_RADIUS_PX + 1, 2 * _EROSION_RADIUS_PX + 1), np.uint8))
        > 0
    )


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
    image, colour = rgb.astype(np.float32), plate.colour.astype(np.float32)
    ones = np.ones((1, 3), dtype=np.float32)
    shading_ratio = cv2.transform(image * colour, ones) / np.maximum(cv2.transform(colour * colour, ones), 1.0)
    shaded = colour * np.clip(shading_ratio, _MIN_SHADOW_RATIO, 1.0)[..., None]
    return plate.known & (largest_difference(image, shaded) > _MAX_PLATE_DIFFERENCE_LEVELS)


def largest_difference(first: Num[np.ndarray, "h w 3"], second: Num[np.ndarray, "h w 3"]) -> Num[np.ndarray, "h w"]:
    """Return the largest absolute difference of a channel at each pixel; the images have one type."""
    return reduce(cv2.max, cv2.split(cv2.absdiff(first, second)))


def _changed_background_fraction(
    changed: Bool[np.ndarray, "h w"], plate: BackgroundPlate, dilated_person: Bool[np.ndarray, "h w"]
) -> float:
    """Return the changed fraction of the known background away from the person; nan if none is known."""
    away = plate.known & ~dilated_person
    return float(changed[away].mean()) if away.any() else float("nan")
