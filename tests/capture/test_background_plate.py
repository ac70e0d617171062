"""The empty scene behind a person, and what covers it, against painted scenes."""

import numpy as np
import pytest

from pipeline.capture.background_plate import covered, find_plate, scene_differs
from pipeline.capture.matting import sharpen_mask

SHAPE = (80, 120)


def scene(seed: int = 0) -> np.ndarray:
    """A wall of blurred patches, every channel between 60 and 200."""
    coarse = np.random.default_rng(seed).integers(60, 200, (10, 15, 3), dtype=np.uint8)
    return coarse.repeat(8, axis=0).repeat(8, axis=1)


def box(left: int, width: int = 30) -> np.ndarray:
    person = np.zeros(SHAPE, bool)
    person[10:70, left : left + width] = True
    return person


def recording(n: int = 16) -> tuple[np.ndarray, np.ndarray]:
    """A black box that walks to the right before a wall with noise of two levels; its masks."""
    rng = np.random.default_rng(1)
    persons = np.stack([box(10 + 4 * k) for k in range(n)])
    noise = rng.integers(-2, 3, (n, *SHAPE, 3))
    return np.where(persons[..., None], 0, scene() + noise).astype(np.uint8), persons


def near(person: np.ndarray) -> np.ndarray:
    grown = person.copy()
    for shift in (-6, 6):
        grown |= np.roll(person, shift, axis=0) | np.roll(person, shift, axis=1)
    return grown


def test_the_plate_is_the_scene_where_the_person_has_left_it():
    images, persons = recording(9)
    plate = find_plate(images, persons)
    seen = (~persons).sum(axis=0) >= 3
    np.testing.assert_array_equal(plate.known, seen)
    assert np.abs(plate.colour[seen].astype(int) - scene()[seen]).max() <= 2


def test_the_plate_is_the_lower_median_of_what_was_seen():
    images = np.random.default_rng(2).integers(0, 256, (7, 4, 5, 3), dtype=np.uint8)
    persons = np.random.default_rng(3).random((7, 4, 5)) < 0.3
    plate = find_plate(images.copy(), persons)
    for row, column in np.argwhere(plate.known):
        seen = np.sort(images[~persons[:, row, column], row, column], axis=0)
        np.testing.assert_array_equal(plate.colour[row, column], seen[(len(seen) - 1) // 2])


def test_a_person_whom_some_masks_miss_leaves_no_trace():
    images, persons = recording()
    persons[3:6] = False
    plate = find_plate(images, persons)
    often = plate.known & ((~persons).sum(axis=0) >= 7)
    assert np.abs(plate.colour[often].astype(int) - scene()[often]).max() <= 2


def test_what_covers_the_plate_is_the_person_without_the_outline():
    images, persons = recording()
    plate = find_plate(images.copy(), persons)
    inner = np.zeros(SHAPE, bool)
    inner[12:68, 12:38] = True
    found = covered(images[0], plate, near(persons[0]))
    np.testing.assert_array_equal(found[:, :38], (inner & plate.known)[:, :38])
    assert not found[:, 40:].any()


def test_a_shadow_covers_nothing_and_a_light_patch_does():
    images, persons = recording()
    plate = find_plate(images.copy(), persons)
    changed = scene().astype(float)
    changed[20:60, 80:90] *= 0.5
    changed[20:60, 100:110] += 40
    found = covered(changed.astype(np.uint8), plate, near(box(75, 40)))
    assert not found[:, 70:95].any()
    assert found[24:56, 104:106].all()


def test_nothing_is_covered_when_the_camera_has_moved():
    images, persons = recording()
    plate = find_plate(images.copy(), persons)
    moved = np.roll(images[0], 5, axis=0)
    assert not covered(moved, plate, near(persons[0])).any()


@pytest.mark.parametrize("moved", [[], [0, 7], [2, 7, 12]])
def test_pictures_from_elsewhere_are_told_from_the_rest(moved):
    images, persons = recording()
    for k in moved:
        images[k] = np.roll(images[k], 5, axis=0)
    before = images.copy()
    np.testing.assert_array_equal(np.flatnonzero(scene_differs(images, np.stack([near(p) for p in persons]))), moved)
    np.testing.assert_array_equal(images, before)


def test_where_the_person_fills_the_picture_no_scene_differs():
    images, persons = recording()
    assert not scene_differs(images, np.ones_like(persons)).any()


@pytest.mark.parametrize("has_plate", [False, True])
def test_the_plate_keeps_what_colours_and_detector_lose(has_plate):
    """Trousers in the colours of a floor that lies elsewhere, where the detector is unsure about them."""
    wall = np.full((*SHAPE, 3), (150, 160, 170), np.uint8)
    wall[:, :35] = (120, 90, 60)
    person = box(40)
    image = np.where(person[..., None], np.uint8([30, 60, 160]), wall)
    image[45:70, 40:70] = (120, 90, 60)
    guess = np.where(person, np.uint8(255), np.uint8(0))
    guess[45:70, 40:44] = 90
    others = [np.where(box(left)[..., None], np.uint8(0), wall) for left in (0, 5, 80, 85, 88)]
    plate = find_plate(np.stack(others), np.stack([box(left) for left in (0, 5, 80, 85, 88)]))
    kept = sharpen_mask(image, guess, plate if has_plate else None)[50:65, 42:44].min() > 0.5
    assert kept == has_plate
