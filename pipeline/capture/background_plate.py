"""The empty scene behind a person who moves before a fixed camera, and what covers it. Pure functions."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

# A pixel is known when at least this many pictures show it without the person.
_MIN_OBSERVATIONS = 3
# Levels of 255 by which a pixel may differ from the plate: video noise and compression.
_MAX_PLATE_DIFFERENCE_LEVELS = 15.0
# What is nearer to an unchanged pixel than this may be covered in part only: half of the width of a blurred outline.
_EROSION_RADIUS_PX = 2
# A shadow leaves at least this share of the light.
_MIN_SHADOW_RATIO = 0.4
# When more of the scene away from the person differs, the camera or the light has moved.
_MAX_CHANGED_FRACTION = 0.05


class BackgroundPlate(NamedTuple):
    """The scene without the person; `colour` means nothing where it is not `known`."""

    colour: UInt8[np.ndarray, "h w 3"]
    known: Bool[np.ndarray, "h w"]

    def window(self, rows: slice, columns: slice) -> BackgroundPlate:
        """A part of it."""
        return BackgroundPlate(self.colour[rows, columns], self.known[rows, columns])


def estimate_background_plate(
    images: UInt8[np.ndarray, "t h w 3"], person_masks: Bool[np.ndarray, "t h w"]
) -> BackgroundPlate:
    """The median over time, for each pixel and channel, of the pictures that do not show the person there.

    `person_masks` must be generous; where it misses the person in less than half of the pictures the median forgives
    it.
    `images` is overwritten, because it is large.
    """
    images[person_masks] = 255
    images.sort(axis=0)
    count = len(images) - person_masks.sum(axis=0)
    middle = np.maximum(count - 1, 0) // 2
    colour = np.take_along_axis(images, middle[None, ..., None], axis=0)[0]
    return BackgroundPlate(colour, count >= _MIN_OBSERVATIONS)


def subtract_background(
    rgb: UInt8[np.ndarray, "h w 3"], plate: BackgroundPlate, dilated_person: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Pixels whose colour, and whose neighbours' colours, neither the plate nor a shadow on it explains.

    A shadow scales the plate's colour. Neighbours count so that pixels that the person covers in part are left out.
    Nothing is covered when the scene away from `dilated_person` has changed as well: the camera has moved.
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
    """Pictures that show another scene than the rest: there the camera, or the light, has moved.

    `person_masks` must be generous.
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
    """Pixels whose colour neither the plate nor a shadow on it explains."""
    image, colour = rgb.astype(np.float32), plate.colour.astype(np.float32)
    ones = np.ones((1, 3), dtype=np.float32)
    shading_ratio = cv2.transform(image * colour, ones) / np.maximum(cv2.transform(colour * colour, ones), 1.0)
    shaded = colour * np.clip(shading_ratio, _MIN_SHADOW_RATIO, 1.0)[..., None]
    return plate.known & (np.abs(image - shaded).max(axis=-1) > _MAX_PLATE_DIFFERENCE_LEVELS)


def _changed_background_fraction(
    changed: Bool[np.ndarray, "h w"], plate: BackgroundPlate, dilated_person: Bool[np.ndarray, "h w"]
) -> float:
    """How much of the known scene away from the person has changed; nan where none is known."""
    away = plate.known & ~dilated_person
    return float(changed[away].mean()) if away.any() else float("nan")
