"""The empty scene behind a person, and what covers it, against painted scenes."""

import numpy as np
import pytest

from pipeline.capture.masks.background_plate import (
    BackgroundPlate,
    PlateComparison,
    compare_with_plate,
    detect_scene_changes,
    estimate_background_plate,
    least_alpha,
)
from pipeline.capture.masks.matting import estimate_alpha_matte

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


def compare(image: np.ndarray, plate: BackgroundPlate, dilated_person: np.ndarray) -> PlateComparison:
    compared = compare_with_plate(image, plate, dilated_person)
    assert compared is not None
    return compared


def test_what_covers_the_plate_is_the_person():
    images, person_masks = recording()
    plate = estimate_background_plate(images.copy(), person_masks)
    covered = least_alpha(compare(images[0], plate, near(person_masks[0])).difference, rim_px=1)
    inner = np.zeros(SHAPE, bool)
    inner[11:69, 11:39] = True
    np.testing.assert_array_equal((covered == 1)[inner], plate.known[inner])
    assert covered[~person_masks[0]].max() == 0


@pytest.mark.parametrize("alpha", [0.6, 0.8])
def test_the_rim_is_covered_by_the_share_of_its_contrast(alpha):
    images, person_masks = recording()
    plate = estimate_background_plate(images.copy(), person_masks)
    flat = plate._replace(colour=np.full_like(plate.colour, 120), known=np.ones(SHAPE, bool))
    image = np.full((*SHAPE, 3), 120.0)
    for share, columns in ((1.0, slice(10, 40)), (alpha, 40), (0.3, 9)):
        image[30:50, columns] += share * (np.array([20, 60, 160]) - 120)
    difference = compare(np.rint(image).astype(np.uint8), flat, near(person_masks[0])).difference
    covered = least_alpha(difference, rim_px=1)
    np.testing.assert_allclose(covered[32:48, 40], alpha, atol=0.005)
    assert covered[32:48, 9].max() == 0
    blurred = least_alpha(difference, rim_px=2)
    assert blurred[32:48, 12:38].min() == 1
    assert blurred[:, 39:].max() == 0


def test_the_density_of_the_plate_is_that_of_its_noise():
    """A normal distribution of twice the noise; far colours are as likely as those at 60 squared deviations."""
    images, person_masks = recording()
    plate = estimate_background_plate(images.copy(), person_masks)
    compared = compare(images[0], plate, near(person_masks[0]))
    away = plate.known & ~near(person_masks[0])
    difference = np.abs(images[0].astype(float) - plate.colour)
    sampled = difference[::3, ::3][away[::3, ::3]]
    everywhere = np.maximum(1.4826 * np.median(sampled, axis=0), 1.2).mean()
    deviation = 2 * np.maximum(plate.deviation, everywhere) / 255
    squared = ((difference / 255) ** 2).sum(axis=-1) / deviation**2
    expected = -0.5 * np.minimum(squared, 60) - 3 * np.log(deviation)
    np.testing.assert_allclose(compared.log_density, expected, rtol=1e-4, atol=1e-4)
    np.testing.assert_array_equal(compared.is_near, plate.known & (squared < 60))


@pytest.mark.parametrize("deviation", [1, 6, 12])
def test_the_plate_tells_how_much_the_scene_moves(deviation):
    """The largest of three channels; also where the person is taken for the scene in a fifth of the images."""
    random = np.random.default_rng(7)
    images = np.clip(random.normal(120, deviation, (60, 12, 12, 3)), 0, 255).astype(np.uint8)
    images[:12] = 20
    plate = estimate_background_plate(images, np.zeros((60, 12, 12), bool))
    assert plate.deviation.mean() == pytest.approx(deviation, rel=0.5, abs=0.7)


def test_a_shadow_covers_nothing_and_a_light_patch_does():
    images, person_masks = recording()
    plate = estimate_background_plate(images.copy(), person_masks)
    changed = scene().astype(float)
    changed[20:60, 80:90] *= 0.5
    changed[20:60, 100:110] += 40
    covered = least_alpha(compare(changed.astype(np.uint8), plate, near(box(75, 40))).difference, rim_px=2)
    assert not covered[:, 70:95].any()
    assert (covered[24:56, 104:106] == 1).all()


def test_no_plate_is_compared_when_the_camera_has_moved():
    images, person_masks = recording()
    plate = estimate_background_plate(images.copy(), person_masks)
    moved = np.roll(images[0], 5, axis=0)
    assert compare_with_plate(moved, plate, near(person_masks[0])) is None


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


def paint(person: np.ndarray, shirt: tuple[int, int, int], wall: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The person before a wall, and what a detector that is sure about the person says."""
    noise = np.random.default_rng(4).integers(-2, 3, wall.shape)
    return np.clip(np.where(person[..., None], shirt, wall) + noise, 0, 255).astype(np.uint8), np.uint8(255) * person


def plate_of(wall: np.ndarray, known: np.ndarray) -> BackgroundPlate:
    noise = np.random.default_rng(5).integers(-2, 3, wall.shape)
    return BackgroundPlate((wall + noise).astype(np.uint8), known, np.zeros(known.shape, np.uint8))


@pytest.mark.parametrize("has_plate", [False, True])
def test_what_looks_like_the_plate_is_background_although_the_person_has_such_colours(has_plate):
    """A gap that the detector does not see, in a shirt with stripes of the colour of the wall."""
    wall = np.full((*SHAPE, 3), (150, 160, 170), np.uint8)
    person = box(40)
    image, guess = paint(person, (230, 230, 235), wall)
    image[10:70:6, 40:70] = image[11:70:6, 40:70] = (135, 145, 150)
    image[30:50, 64:67] = plate_of(wall, person).colour[30:50, 64:67]
    alpha = estimate_alpha_matte(image, guess, plate_of(wall, np.ones(SHAPE, bool)) if has_plate else None)
    assert (alpha[33:47, 65].max() < 0.5) == has_plate
    assert alpha[12:28, 42:60].min() > 0.5


@pytest.mark.parametrize("is_wall_known", [False, True])
def test_a_print_in_the_colour_of_the_wall_is_filled_where_no_frame_shows_the_wall(is_wall_known):
    shirt, wall = np.array([180, 30, 40]), np.full((*SHAPE, 3), (200, 200, 195), np.uint8)
    image, guess = paint(box(40), tuple(shirt), wall)
    image[30:36, 50:62] = wall[0, 0] + 0.7 * (shirt - wall[0, 0])
    image[32:34, 51:55] = wall[0, 0] + 0.1 * (shirt - wall[0, 0])
    known = np.ones(SHAPE, bool)
    known[20:60, 45:65] = is_wall_known
    found = [estimate_alpha_matte(image, guess, plate)[30:36, 50:62].min() for plate in (None, plate_of(wall, known))]
    assert found[0] < 0.5
    assert found[1] < 0.5 if is_wall_known else found[1] == 1
