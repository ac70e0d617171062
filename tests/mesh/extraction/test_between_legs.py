"""The space between two legs: strands and ridges are excess, trousers and skirts are not; valleys are closed."""

from dataclasses import replace

import numpy as np

from pipeline.mesh.extraction.between_legs import (
    PARTING_M,
    VALLEY_RADIUS_M,
    LegGrid,
    close_valleys,
    excess_between_legs,
    gaps_in_skirt,
    parted_legs,
)
from tests.mesh.extraction.two_legs import CROTCH_M, GRID_M, LEG_RADIUS_M, LEG_X_M, leg_grid


def test_strands_and_ridges_between_legs_are_excess() -> None:
    """The trousers are 1 cm from the legs all around; the ridge goes 4 cm farther, the strand touches nothing."""
    grid, (x, y, z) = leg_grid()
    trousers = grid.body_distance_m < 0.01
    below = y < CROTCH_M - 0.02
    strand = below & (np.hypot(x - 0.01, z - 0.08) < 0.012)
    ridge = below & (y > 0.2) & (np.abs(z - 0.03) < 0.012) & (x > -LEG_X_M) & (x < -LEG_X_M + LEG_RADIUS_M + 0.05)
    excess = excess_between_legs(trousers | strand | ridge, grid)
    assert excess[strand & ~trousers].all()
    assert not excess[trousers].any()
    beyond = ridge & (grid.body_distance_m > 0.02) & (y < CROTCH_M - 0.1)
    assert beyond.sum() > 100
    assert excess[beyond].all()
    assert not excess[~(strand | ridge)].any()


def test_wide_trousers_are_as_wide_inside_as_outside() -> None:
    grid, _ = leg_grid()
    wide = grid.body_distance_m < 0.04
    assert not excess_between_legs(wide, grid).any()


def test_what_is_beside_the_legs_stays() -> None:
    """A cord that hangs on the outer side, and cloth on the outer side of one leg."""
    grid, (x, y, z) = leg_grid()
    trousers, below = grid.body_distance_m < 0.01, y < CROTCH_M - 0.02
    cord = below & (np.hypot(x - 0.25, z) < 0.012)
    flare = below & (x > LEG_X_M) & (grid.body_distance_m < 0.05)
    assert not excess_between_legs(trousers | cord | flare, grid).any()
    button = below & (x > LEG_X_M) & (np.abs(z) < 0.5 * GRID_M) & (grid.body_distance_m < 0.042)
    assert not excess_between_legs((grid.body_distance_m < 0.02) | button, grid).any()


def test_a_skirt_is_no_excess() -> None:
    """Cloth from leg to leg, and a ring around both that touches neither."""
    grid, (x, y, z) = leg_grid()
    trousers, below = grid.body_distance_m < 0.01, y < CROTCH_M - 0.02
    cloth = below & (np.abs(x) < LEG_X_M) & (np.abs(np.abs(z) - 0.05) < 0.012)
    assert not excess_between_legs(trousers | cloth, grid).any()
    ring = below & (np.abs(np.hypot(x / 1.4, z) - 0.18) < 0.01)
    assert not excess_between_legs(trousers | ring, grid).any()


def test_a_body_without_two_legs_has_no_excess() -> None:
    grid, (x, y, z) = leg_grid()
    ball_m = np.sqrt(x**2 + (y - 0.3) ** 2 + z**2) - 0.1
    assert not excess_between_legs(ball_m < 0.02, replace(grid, body_distance_m=ball_m)).any()


def joined_trousers(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Signed distance of trouser legs that touch each other from 0.37 m up, with a slit 2 cm wide in front of there."""
    legs_m = np.hypot(np.abs(x) - LEG_X_M, z) - np.interp(y, (0.2, 0.42), (0.09, 0.13))
    slit_m = np.maximum(np.abs(x) - 0.01, 0.02 - z)
    return np.maximum(legs_m, -slit_m)


def test_a_valley_between_joined_legs_is_closed() -> None:
    grid, (x, y, z) = leg_grid()
    before_m = joined_trousers(x, y, z)
    after_m = close_valleys(before_m, grid)
    in_slit = (np.abs(x) < 0.006) & (y > 0.43) & (y < 0.52) & (z > 0.02) & (z < 0.05)
    assert (before_m[in_slit] > 0.0).all()
    assert (after_m[in_slit] < 0.0).all()
    # Nothing is cleared but by the smoothing, and nothing beside the valley changes.
    assert (after_m - before_m).max() < 0.01
    beside = (np.abs(x) > 0.1) | (y < 0.25)
    np.testing.assert_array_equal(after_m[beside], before_m[beside])


def test_legs_apart_stay_apart() -> None:
    grid, (x, y, z) = leg_grid()
    apart_m = grid.body_distance_m - 0.01
    after_m = close_valleys(apart_m, grid)
    far_below = y < CROTCH_M - 0.01 - VALLEY_RADIUS_M
    middle = np.abs(x) < 0.02
    assert (after_m[far_below & middle] > 0.0).all()


def test_a_skirt_has_no_valleys() -> None:
    grid, coordinates = leg_grid()
    before_m = joined_trousers(*coordinates)
    assert close_valleys(before_m, grid) is not before_m
    assert close_valleys(before_m, replace(grid, hem_m=0.1)) is before_m


def test_a_solid_without_legs_has_no_valleys() -> None:
    grid, (x, y, z) = leg_grid()
    far_m = np.hypot(x - 0.2, z) - 0.05
    assert close_valleys(far_m, replace(grid, crotch_m=0.0)) is far_m


SKIRT_HEM_M = 0.1


def pierced_skirt(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A skirt with a hole in front and a notch in its hem behind: what is left, the hole, the notch."""
    skirt = (np.hypot(x, 1.3 * z) < 0.24) & (y > SKIRT_HEM_M)
    hole = (np.hypot(x - 0.03, y - 0.3) < 0.02) & (z > SKIRT_HEM_M)
    notch = (np.abs(x) < 0.02) & (y < 0.18) & (z < -0.06)
    return skirt & ~hole & ~notch, hole & skirt, notch & skirt


def test_holes_and_notches_of_a_skirt_are_gaps() -> None:
    grid, coordinates = leg_grid(hem_m=SKIRT_HEM_M)
    inside, hole, notch = pierced_skirt(*coordinates)
    gaps = gaps_in_skirt(inside | (grid.body_distance_m < 0.0), grid)
    assert gaps[hole].mean() > 0.9  # the disc leaves corners
    assert gaps[notch].mean() > 0.9
    # Outlines stay, and a skirt without gaps has none.
    assert not gaps[~(hole | notch)].any()
    assert not gaps_in_skirt(inside | hole | notch, grid).any()


def test_only_above_a_hem_are_gaps_of_a_skirt() -> None:
    """Neither trouser legs that touch each other over 13 cm nor a pierced skirt without one have any."""
    grid, coordinates = leg_grid()
    assert not gaps_in_skirt(joined_trousers(*coordinates) < 0.0, grid).any()
    assert not gaps_in_skirt(pierced_skirt(*coordinates)[0], grid).any()


def test_a_slot_across_the_front_of_a_skirt_is_a_gap() -> None:
    """A disc enters it in each of its slices; a ball cannot."""
    grid, (x, y, z) = leg_grid(hem_m=SKIRT_HEM_M)
    skirt = (np.hypot(x, 1.3 * z) < 0.24) & (y > SKIRT_HEM_M)
    slot = skirt & (np.abs(y - 0.3) < 0.02) & (z > 0.07)
    gaps = gaps_in_skirt((skirt & ~slot) | (grid.body_distance_m < 0.0), grid)
    assert gaps[slot].mean() > 0.9
    assert not gaps[~slot].any()


def test_a_hole_through_a_skirt_that_parts_it_is_a_gap_above_a_hem() -> None:
    """Between the legs, from front to back, 4 cm high; bare legs below the hem."""
    grid, (x, y, z) = leg_grid(hem_m=SKIRT_HEM_M)
    skirt = (np.hypot(x, 1.3 * z) < 0.24) & (y > SKIRT_HEM_M)
    hole = skirt & (np.abs(x) < 0.04) & (np.abs(y - 0.3) < 0.02)
    gaps = gaps_in_skirt((skirt & ~hole) | (grid.body_distance_m < 0.0), grid)
    assert gaps[hole].mean() > 0.9
    assert not gaps[~hole].any()


def test_a_coat_has_no_holes_above_the_crotch() -> None:
    grid, (x, y, z) = leg_grid(hem_m=SKIRT_HEM_M)
    coat = (np.hypot(x, 1.25 * z) < 0.24) & (y > SKIRT_HEM_M)
    hole = coat & (np.hypot(z, y - CROTCH_M - 0.06) < 0.02) & (x > 0.185)
    assert gaps_in_skirt((coat & ~hole) | (grid.body_distance_m < 0.0), grid)[hole].mean() > 0.9


def test_cloth_that_frames_put_on_either_leg_becomes_one_skirt() -> None:
    """Filmed from in front with legs apart, it lies around each leg, 10 cm from the other one's. Its outside stays."""
    grid, (x, y, z) = leg_grid(hem_m=SKIRT_HEM_M)
    around_legs = (grid.body_distance_m < 0.01) & (y > SKIRT_HEM_M) & (y < CROTCH_M) | (grid.body_distance_m < 0.0)
    gaps = gaps_in_skirt(around_legs, grid)
    between = (np.abs(x) < 0.05) & (np.abs(z) < 0.02) & (y > SKIRT_HEM_M + 0.02)
    assert (around_legs | gaps)[between].all()
    assert not gaps[(np.abs(x) > LEG_X_M) & (y < CROTCH_M - 0.1) | (y < SKIRT_HEM_M - GRID_M)].any()
    cloth = (around_legs | gaps) & (np.abs(y - 0.3) < 0.01) & (np.abs(x) < 0.01)
    assert 0.03 < np.abs(z[cloth]).max() < LEG_RADIUS_M


HEM_M = 0.25
CLOSE_LEG_X_M = 0.09
"""Legs 6 cm from each other."""


def coat_over_trousers() -> tuple[np.ndarray, LegGrid, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """A coat down to `HEM_M` over trousers 3.5 cm wider than the legs, which touch each other; grid, coordinates."""
    grid, (x, y, z) = leg_grid(CLOSE_LEG_X_M, HEM_M)
    coat = (np.hypot(x / 1.1, z) < 0.22) & (y > HEM_M)
    return (grid.body_distance_m < 0.035) & (y < CROTCH_M) | (grid.body_distance_m < 0.0) | coat, grid, (x, y, z)


def test_trousers_are_parted_below_the_hem_of_a_coat() -> None:
    inside, grid, (x, y, z) = coat_over_trousers()
    indicator = parted_legs(grid)
    below = y < HEM_M - 0.015
    apart = (np.abs(x) > 0.5 * PARTING_M + GRID_M) & (np.abs(z) < 0.03)
    assert (indicator[below & (np.abs(x) < 0.3 * PARTING_M)] < 0.5).all()
    assert (indicator[below & apart] > 0.5).all()
    assert (indicator[(grid.body_distance_m < 0.0) | (y > HEM_M + 0.015)] == 1.0).all()
    assert np.count_nonzero(inside & below & (indicator < 0.5)) > 100


def test_below_its_hem_a_coat_has_no_gaps() -> None:
    """The notches between both trouser legs stay."""
    inside, grid, (_, y, _) = coat_over_trousers()
    assert not gaps_in_skirt(inside, grid)[y < HEM_M - 0.015].any()


def test_without_a_hem_legs_are_not_parted() -> None:
    grid, _ = leg_grid(CLOSE_LEG_X_M)
    assert (parted_legs(grid) == 1.0).all()
