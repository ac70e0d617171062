"""The checkpoint of the detections: what was saved is read back."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from pipeline.capture.detection_checkpoint import load_detections, save_detections
from tests.capture.test_input_checks import make_detections


def test_what_was_saved_is_read_back(tmp_path: Path) -> None:
    saved = replace(make_detections(3), masks_png=(b"one", b"", b"three"), scale=1 / 3)
    saved.time_s[1] = 1 / 7
    save_detections(tmp_path / "checkpoint", saved)
    found = load_detections(tmp_path / "checkpoint")
    assert found is not None
    assert (found.masks_png, found.width, found.height, found.scale) == (saved.masks_png, 100, 100, 1 / 3)
    pairs = [(vars(found)[name], value) for name, value in vars(saved).items() if isinstance(value, np.ndarray)]
    pairs += zip(vars(found.hands).values(), vars(saved.hands).values(), strict=True)
    for value, wanted in pairs:
        np.testing.assert_array_equal(value, wanted)
        assert value.dtype == wanted.dtype


def test_without_a_file_there_are_no_detections(tmp_path: Path) -> None:
    assert load_detections(tmp_path / "checkpoint") is None
