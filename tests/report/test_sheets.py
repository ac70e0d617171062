"""Sheets keep every picture, whole and in order."""

import numpy as np
import pytest

from pipeline.report.sheets import GAP_PX, composite_on_white_uint8, image_grid


def plain(height: int, width: int, level: int) -> np.ndarray:
    return np.full((height, width, 3), level, dtype=np.uint8)


def test_pictures_lie_side_by_side_on_white():
    sheet = image_grid([[plain(5, 4, 10), plain(9, 6, 20)], [], [plain(2, 3, 30)]])
    assert sheet.shape == (9 + 2 + 3 * GAP_PX, 4 + 6 + 3 * GAP_PX, 3)
    for level, count in ((10, 5 * 4), (20, 9 * 6), (30, 2 * 3)):
        assert (sheet == level).all(axis=2).sum() == count
    assert (sheet[GAP_PX : GAP_PX + 5, GAP_PX : GAP_PX + 4] == 10).all()
    assert (sheet == 255).all(axis=2).sum() == sheet.shape[0] * sheet.shape[1] - 20 - 54 - 6


def test_a_sheet_of_nothing_is_refused():
    with pytest.raises(ValueError, match="at least one"):
        image_grid([[], []])


def test_alpha_is_straight():
    picture = np.array([[[200, 100, 0, 255], [200, 100, 0, 0], [0, 0, 0, 51]]], dtype=np.uint8)
    assert composite_on_white_uint8(picture).tolist() == [[[200, 100, 0], [255, 255, 255], [204, 204, 204]]]
