import numpy as np
import pytest

from pipeline.avatar.body import load_anny
from pipeline.avatar.fit import FitResult
from pipeline.avatar.fit_quality import doubts, frame_ranges, make_observations, suspicious_frames
from pipeline.geometry.camera import Camera

FRAMES = 12
CAMERA = Camera(500.0, 500.0, 100.0, 100.0, 200, 200)


def result(**changes: object) -> FitResult:
    fields: dict[str, object] = {
        "body": load_anny().body(load_anny().shape_defaults),
        "rotations_wxyz": np.tile(np.float32([1, 0, 0, 0]), (FRAMES, 52, 1)),
        "root_translation_m": np.zeros((FRAMES, 3), dtype=np.float32),
        "camera": CAMERA,
        "landmark_error_px": np.full(FRAMES, 2.0),
        "overlap": np.full(FRAMES, 0.93),
        "exchanged": {"whole body": np.zeros(FRAMES, dtype=bool), "legs": np.zeros(FRAMES, dtype=bool)},
        "focal_deviation": 0.1,
        "height_deviation_m": 0.05,
    }
    return FitResult(**(fields | changes))


def test_ranges_join_neighbours_among_the_chosen_frames() -> None:
    index = np.array([0, 3, 6, 9, 12, 40])
    assert frame_ranges(index, np.array([1, 0, 1, 1, 1, 0], dtype=bool)) == "0, 6-12"
    assert frame_ranges(index, np.zeros(6, dtype=bool)) == ""
    assert frame_ranges(index, np.ones(6, dtype=bool)) == "0-40"


def test_a_good_fit_raises_no_doubt() -> None:
    assert doubts(result(), np.arange(FRAMES)) == []


@pytest.mark.parametrize(
    ("changes", "row", "words"),
    [
        ({"overlap": 0.6}, 3, "frames 6: the body fits worse"),
        ({"landmark_error_px": 9.0}, 5, "frames 10: the body fits worse"),
        ({"landmark_error_px": np.nan}, 2, "frames 4: no landmarks"),
    ],
)
def test_doubtful_frames_are_named(changes: dict[str, float], row: int, words: str) -> None:
    name, value = next(iter(changes.items()))
    values = getattr(result(), name).copy()
    values[row] = value
    found = result(**{name: values})
    assert np.flatnonzero(suspicious_frames(found)).tolist() == [row]
    (sentence,) = doubts(found, 2 * np.arange(FRAMES))
    assert sentence.startswith(words)


def test_an_unsure_focal_length_is_told_with_a_remedy() -> None:
    (sentence,) = doubts(result(focal_deviation=0.2), np.arange(FRAMES))
    assert sentence.startswith("focal length 500 px is known to 20 % only")
    assert "camera.json" in sentence


def test_exchanged_legs_are_told() -> None:
    legs = np.arange(FRAMES) > 8
    (sentence,) = doubts(result(exchanged={"legs": legs}), np.arange(FRAMES))
    assert "frames 9-11" in sentence
    assert "left and right legs" in sentence


def test_observations_turn_the_detectors_axes_and_mark_what_is_missing() -> None:
    landmarks, world = np.ones((2, 33, 2)), np.tile([0.1, 0.2, 0.3], (2, 33, 1))
    landmarks[0, 5], world[1, 7] = np.nan, np.nan
    seen = make_observations(np.arange(2.0), landmarks, np.ones((2, 33)), world, CAMERA)
    assert np.allclose(seen.directions_m[0, 0], [0.1, -0.2, -0.3])
    assert seen.confidence[0, 5] == 0.0
    assert seen.direction_confidence[1, 7] == 0.0
    assert seen.confidence.sum() == 65.0
    assert seen.landmarks_px.isfinite().all()
