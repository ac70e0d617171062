"""The empty scene behind a person who moves before a fixed camera, and what covers it. Pure functions."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

# A pixel is known when at least this many pictures show it without the person.
_LEAST_PICTURES = 3
# Levels of 255 by which a pixel may differ from the plate: video noise and compression.
_CHANGE_LEVELS = 15.0
# What is nearer to an unchanged pixel than this may be covered in part only: half of the width of a blurred outline.
_MIXED_PX = 2
# A shadow leaves at least this share of the light.
_DEEPEST_SHADOW = 0.4
# When more of the scene away from the person differs, the camera or the light has moved.
_MOST_CHANGED = 0.05


class Plate(NamedTuple):
    """The scene without the person; `colour` means nothing where it is not `known`."""

    colour: UInt8[np.ndarray, "h w 3"]
    known: Bool[np.ndarray, "h w"]

    def window(self, rows: slice, columns: slice) -> Plate:
        """A part of it."""
        return Plate(self.colour[rows, columns], self.known[rows, columns])


def find_plate(images: UInt8[np.ndarray, "t h w 3"], persons: Bool[np.ndarray, "t h w"]) -> Plate:
    """The median over time, for each pixel and channel, of the pictures that do not show the person there.

    `persons` must be generous; where it misses the person in less than half of the pictures the median forgives it.
    `images` is overwritten, because it is large.
    """
    images[persons] = 255
    images.sort(axis=0)
    count = len(images) - persons.sum(axis=0)
    middle = np.maximum(count - 1, 0) // 2
    colour = np.take_along_axis(images, middle[None, ..., None], axis=0)[0]
    return Plate(colour, count >= _LEAST_PICTURES)


def covered(
    rgb: UInt8[np.ndarray, "h w 3"], plate: Plate, near_person: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Pixels whose colour, and whose neighbours' colours, neither the plate nor a shadow on it explains.

    A shadow scales the plate's colour. Neighbours count so that pixels that the person covers in part are left out.
    Nothing is covered when the scene away from `near_person` has changed as well: the camera has moved.
    """
    changed = _changed(rgb, plate)
    share = _share_away(changed, plate, near_person)
    if np.isnan(share) or share > _MOST_CHANGED:
        return np.zeros_like(changed)
    return cv2.erode(changed.astype(np.uint8), np.ones((2 * _MIXED_PX + 1, 2 * _MIXED_PX + 1), np.uint8)) > 0


def scene_differs(images: UInt8[np.ndarray, "t h w 3"], persons: Bool[np.ndarray, "t h w"]) -> Bool[np.ndarray, "t"]:
    """Pictures that show another scene than the rest: there the camera, or the light, has moved.

    `persons` must be generous.
    """
    plate = find_plate(images.copy(), persons)
    pairs = zip(images, persons, strict=True)
    return np.array([_share_away(_changed(image, plate), plate, person) > _MOST_CHANGED for image, person in pairs])


def _changed(rgb: UInt8[np.ndarray, "h w 3"], plate: Plate) -> Bool[np.ndarray, "h w"]:
    """Pixels whose colour neither the plate nor a shadow on it explains."""
    image, colour = rgb.astype(np.float32), plate.colour.astype(np.float32)
    ones = np.ones((1, 3), dtype=np.float32)
    light = cv2.transform(image * colour, ones) / np.maximum(cv2.transform(colour * colour, ones), 1.0)
    shaded = colour * np.clip(light, _DEEPEST_SHADOW, 1.0)[..., None]
    return plate.known & (np.abs(image - shaded).max(axis=-1) > _CHANGE_LEVELS)


def _share_away(changed: Bool[np.ndarray, "h w"], plate: Plate, near_person: Bool[np.ndarray, "h w"]) -> float:
    """How much of the known scene away from the person has changed; nan where none is known."""
    away = plate.known & ~near_person
    return float(changed[away].mean()) if away.any() else float("nan")
