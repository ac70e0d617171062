import numpy as np
import pytest

from pipeline.capture.masks.raggedness import MAX_RAGGED_SHARE, ragged_share


def standing_person() -> np.ndarray:
    """Return a mask of 500 px height: a trunk, a head, two arms of 24 px and two legs."""
    rows, columns = np.mgrid[:600, :400] + 0.5
    head = np.hypot(rows - 85, columns - 200) < 35
    trunk = (np.abs(columns - 200) < 60) & (rows > 115) & (rows < 320)
    arms = (np.abs(np.abs(columns - 200) - 60 - 0.5 * (rows - 130)) < 12) & (rows > 130) & (rows < 330)
    legs = (np.abs(np.abs(columns - 200) - 32) < 24) & (rows >= 320) & (rows < 550)
    return (head | trunk | arms | legs).astype(np.float32)


def test_a_clean_mask_hardly_changes() -> None:
    assert ragged_share(standing_person()) < 0.3 * MAX_RAGGED_SHARE


@pytest.mark.parametrize("added", ["specks", "holes", "frayed"])
def test_defects_are_found(added: str) -> None:
    mask, random = standing_person(), np.random.default_rng(0)
    noise = random.random(mask.shape)
    if added == "specks":
        mask[(noise < 0.02) & (mask == 0.0)] = 1.0
    elif added == "holes":
        mask[(noise < 0.05) & (mask == 1.0)] = 0.0
    else:
        shift_px = random.integers(0, 8, len(mask))
        mask = np.stack([np.roll(row, shift) for row, shift in zip(mask, shift_px, strict=True)])
    assert ragged_share(mask) > MAX_RAGGED_SHARE


def test_an_empty_mask_has_none() -> None:
    assert ragged_share(np.zeros((20, 20), np.float32)) == 0.0
