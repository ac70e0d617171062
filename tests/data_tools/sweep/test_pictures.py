"""The README's images: four labelled tiles of equal size; a run without report is refused."""

from pathlib import Path

import numpy as np
import pytest

from data_tools.sweep.pictures import GREEN, LABEL_PX, RED, TILE_PX, filming_sheet, main
from pipeline.core.errors import UserError


def person_image() -> tuple[np.ndarray, np.ndarray]:
    image = np.full((240, 200, 3), 200, dtype=np.uint8)
    mask = np.zeros((240, 200), dtype=bool)
    mask[20:220, 80:120] = True
    image[mask] = (10, 20, 30)
    return image, mask


def test_one_good_and_three_bad_tiles() -> None:
    sheet = filming_sheet(*person_image())
    assert sheet.shape == (TILE_PX + LABEL_PX, 4 * TILE_PX, 3)
    bars = [tuple(sheet[-1, k * TILE_PX + 2].tolist()) for k in range(4)]
    assert bars == [GREEN, RED, RED, RED]


def test_the_far_person_is_smaller_and_the_cut_person_has_no_feet() -> None:
    sheet = filming_sheet(*person_image())[:TILE_PX]
    good, cut, far, two = (
        np.abs(sheet[:, k * TILE_PX : (k + 1) * TILE_PX].astype(int) - (10, 20, 30)).max(axis=2) < 9 for k in range(4)
    )
    assert far.sum() < 0.3 * good.sum()
    assert cut[-1].any()
    assert not good[-1].any()
    columns = np.flatnonzero(np.diff(two.any(axis=0).astype(int)) == 1)
    assert len(columns) == 2


def test_an_empty_mask_and_a_run_without_report_are_refused(tmp_path: Path) -> None:
    image, mask = person_image()
    with pytest.raises(UserError, match="no person"):
        filming_sheet(image, np.zeros_like(mask))
    with pytest.raises(UserError, match="does not exist"):
        main([str(tmp_path)])
