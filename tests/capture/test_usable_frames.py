from pathlib import Path

import numpy as np
import pytest

from pipeline.capture.capture import Capture
from pipeline.capture.frame_selection import VALIDATION
from pipeline.capture.usable_frames import SCORES_NPZ, usable_positions
from pipeline.core.errors import UserError
from pipeline.io.npz import save_npz

SPLIT = np.array([0, 1, 2, 0, 0], dtype=np.uint8)


def capture(folder: Path) -> Capture:
    index, nowhere = np.arange(len(SPLIT)), np.full((len(SPLIT), 33, 3), np.nan)
    landmarks = nowhere[..., :2], nowhere[..., 0], nowhere
    return Capture(folder, index, index / 10.0, SPLIT, 10.0, 8, 8, *landmarks, None, "truth", 5, 1.0)


def test_training_frames_are_those_whose_fit_is_usable(tmp_path: Path) -> None:
    save_npz(tmp_path / SCORES_NPZ, {"usable": np.array([False, True, True, True, True])})
    assert usable_positions(capture(tmp_path), tmp_path).tolist() == [3, 4]
    save_npz(tmp_path / SCORES_NPZ, {"usable": np.ones(5, dtype=bool)})
    assert usable_positions(capture(tmp_path), tmp_path).tolist() == [0, 3, 4]


def test_validation_frames_are_those_whose_fit_is_usable(tmp_path: Path) -> None:
    for usable, expected in ((True, [1]), (False, [])):
        save_npz(tmp_path / SCORES_NPZ, {"usable": np.array([True, usable, True, True, True])})
        assert usable_positions(capture(tmp_path), tmp_path, VALIDATION).tolist() == expected


@pytest.mark.parametrize("arrays", [{"frame_index": np.arange(5)}, {"usable": np.ones(4, dtype=bool)}])
def test_incomplete_scores_are_refused_with_a_remedy(tmp_path: Path, arrays: dict[str, np.ndarray]) -> None:
    save_npz(tmp_path / SCORES_NPZ, arrays)
    with pytest.raises(UserError, match=r"which of the 5 frames are usable.*stages body"):
        usable_positions(capture(tmp_path), tmp_path)


def test_missing_scores_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="scores.npz"):
        usable_positions(capture(tmp_path), tmp_path)
