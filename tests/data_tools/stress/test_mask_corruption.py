"""Damage of masks against closed forms."""

from pathlib import Path

import numpy as np
import pytest

from data_tools.evaluate.truth import load_ground_truth, load_true_mask
from data_tools.stress.mask_corruption import HOLES_PER_FRAME, MASK_CORRUPTIONS, blur, erode, lose_limb, punch_holes


def square(side_px: int = 40) -> np.ndarray:
    mask = np.zeros((100, 100), np.uint8)
    low = 50 - side_px // 2
    mask[low : low + side_px, low : low + side_px] = 255
    return mask


@pytest.mark.parametrize("radius_px", [1, 2, 8])
def test_erosion_and_dilation_move_a_straight_edge_by_their_radius(radius_px: int) -> None:
    for sign in (1, -1):
        changed = erode(square(), float(sign * radius_px))
        rows, columns = np.nonzero(changed)
        assert np.ptp(rows) + 1 == np.ptp(columns) + 1 == 40 - 2 * sign * radius_px


def test_no_radius_is_no_change() -> None:
    assert (erode(square(), 0.0) == square()).all()
    assert (blur(square(), 0.0) == square()).all()


def test_holes_are_disks_of_their_radius() -> None:
    holed = punch_holes(square(80), 5.0, np.random.default_rng(0))
    lost = np.count_nonzero(holed != square(80))
    disk = np.pi * 5.0**2
    assert 1.5 * disk < lost < 1.2 * HOLES_PER_FRAME * disk
    assert (punch_holes(np.zeros((9, 9), np.uint8), 3.0, np.random.default_rng(0)) == 0).all()


def test_a_blurred_edge_has_the_width_of_its_gaussian() -> None:
    row = blur(square(), 3.0)[50].astype(float) / 255.0
    gradient = np.abs(np.diff(row))[:50]
    middle = (np.arange(50) * gradient).sum() / gradient.sum()
    std = np.sqrt(((np.arange(50) - middle) ** 2 * gradient).sum() / gradient.sum())
    assert std == pytest.approx(3.0, rel=0.05)


def test_a_lost_limb_is_part_of_the_person(sample: Path) -> None:
    capture = load_ground_truth(sample)
    mask = load_true_mask(sample, 0)
    lost = lose_limb(mask, capture, 0)
    share = np.count_nonzero((lost == 0) & (mask > 127)) / np.count_nonzero(mask > 127)
    assert 0.01 < share < 0.15
    assert (lost <= mask).all()


def test_limbs_are_lost_in_the_share_of_frames_and_black_is_black(sample: Path) -> None:
    capture = load_ground_truth(sample)
    masks = [load_true_mask(sample, frame) for frame in range(6)]
    damaged = [MASK_CORRUPTIONS["lost_limb"](mask, capture, frame, 0.2) for frame, mask in enumerate(masks)]
    changed = [bool((a != b).any()) for a, b in zip(damaged, masks, strict=True)]
    assert changed == [True, False, False, False, False, True]
    assert not MASK_CORRUPTIONS["black"](masks[0], capture, 0, 1.0).any()
