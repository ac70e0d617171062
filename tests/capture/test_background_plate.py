"""The empty scene behind a person, and what covers it, against painted scenes."""

import numpy as np
import pytest

from pipeline.capture.background_plate import detect_scene_changes, estimate_background_plate, subtract_background
from pipeline.capture.matting import estimate_alpha_matte

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
    person_masks = np.stack([box(10 + 4 * k) for k in range(n)])
    noise = rng.integers(-2, 3, (n, *SHAPE, 3))
    return np.where(person_masks[..., None], 0, scene() + noise).astype(np.uint8), person_masks


def near(person: np.ndarray) -> np.ndarray:
    grown = person.copy()
    for shift in (-6, 6):
        grown |= np.roll(person, shift, axis=0) | np.roll(person, shift, axis=1)
    return grown


def test_the_plate_is_the_scene_where_the_person_has_left_it():
    images, person_masks = recording(9)
    plate = estimate_background_plate(images, person_masks)
    seen = (~person_masks).sum(axis=0) >= 3
    np.testing.assert_array_equal(plate.known, seen)
    assert np.abs(plate.colour[seen].astype(int) - scene()[seen]).max() <= 2


def test_the_plate_is_the_lower_median_of_what_was_seen():
    images = np.random.default_rng(2).integers(0, 256, (7, 4, 5, 3), dtype=np.uint8)
    person_masks = np.random.default_rng(3).random((7, 4, 5)) < 0.3
    plate = estimate_background_plate(images.copy(), person_masks)
    for row, column in np.argwhere(plate.known):
        seen = np.sort(images[~person_masks[:, row, column], row, column], axis=0)
        np.testing.assert_array_equal(plate.colour[row, column], seen[(len(seen) - 1) // 2])


def test_a_person_whom_some_masks_miss_leaves_no_trace():
    images, person_masks = recording()
    person_masks[3:6] = False
    plate = estimate_background_plate(images, person_masks)
    often = plate.known & ((~person_masks).sum(axis=0) >= 7)
    assert np.abs(plate.colour[often].astype(int) - scene()[often]).max() <= 2


def test_what_covers_the_plate_is_the_person_without_the_outline():
    images, person_masks = recording()
    plate = estimate_background_plate(images.copy(), person_masks)
    inner = np.zeros(SHAPE, bool)
    inner[12:68, 12:38] = True
    found = subtract_background(images[0], plate, near(person_masks[0]))
    np.testing.assert_array_equal(found[:, :38], (inner & plate.known)[:, :38])
    assert not found[:, 40:].any()


def test_a_shadow_covers_nothing_and_a_light_patch_does():
    images, person_masks = recording()
    plate = estimate_background_plate(images.copy(), person_masks)
    changed = scene().astype(float)
    changed[20:60, 80:90] *= 0.5
    changed[20:60, 100:110] += 40
    found = subtract_background(changed.astype(np.uint8), plate, near(box(75, 40)))
    assert not found[:, 70:95].any()
    assert found[24:56, 104:106].all()


def test_nothing_is_covered_when_the_camera_has_moved():
    images, person_masks = recording()
    plate = estimate_background_plate(images.copy(), person_masks)
    moved = np.roll(images[0], 5, axis=0)
    assert not subtract_background(moved, plate, near(person_masks[0])).any()


@pytest.mark.parametrize("moved", [[], [0, 7], [2, 7, 12]])
def test_frames_of_another_scene_are_detected(moved):
    images, person_masks = recording()
    for k in moved:
        images[k] = np.roll(images[k], 5, axis=0)
    before = images.copy()
    np.testing.assert_array_equal(
        np.flatnonzero(detect_scene_changes(images, np.stack([near(p) for p in person_masks]))), moved
    )
    np.testing.assert_array_equal(images, before)


def test_where_the_person_fills_the_picture_no_scene_differs():
    images, person_masks = recording()
    assert not detect_scene_changes(images, np.ones_like(person_masks)).any()


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
    plate = estimate_background_plate(np.stack(others), np.stack([box(left) for left in (0, 5, 80, 85, 88)]))
    kept = estimate_alpha_matte(image, guess, plate if has_plate else None)[50:65, 42:44].min() > 0.5
    assert kept == has_plate
