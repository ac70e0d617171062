from functools import cache

import numpy as np
import pytest

from pipeline.body.body import Body, load_anny
from pipeline.body.fit.diagnostics import (
    FRAME_RATINGS,
    finite_median,
    fit_warnings,
    make_observations,
    median_silhouette_iou,
    rate_frames,
    select_overlay_frames,
    suspicious_frames,
    usable_frames,
)
from pipeline.body.fit.landmark_regressor import landmark_regressor
from pipeline.body.fit.linear_body import linearise_body
from pipeline.body.fit.result import FitResult, landmark_errors_px
from pipeline.geometry.camera import Camera
from tests.body.acting import synthetic_recording

FRAMES = 12
ALL = np.ones(FRAMES, dtype=bool)
CAMERA = Camera(500.0, 500.0, 100.0, 100.0, 200, 200)


@cache
def default_body() -> Body:
    return load_anny().at_shape(load_anny().shape_defaults)


def result(**changes: object) -> FitResult:
    """Return a good fit of a person at 2 m, about 460 pixels tall."""
    fields: dict[str, object] = {
        "body": default_body(),
        "bare": default_body(),
        "rotations_wxyz": np.tile(np.float32([1, 0, 0, 0]), (FRAMES, 52, 1)),
        "root_translation_m": np.tile(np.float32([0, 0, -2]), (FRAMES, 1)),
        "camera": CAMERA,
        "landmark_error_px": np.full(FRAMES, 2.0),
        "silhouette_iou": np.full(FRAMES, 0.93),
        "left_right_swapped": {"whole body": np.zeros(FRAMES, dtype=bool), "legs": np.zeros(FRAMES, dtype=bool)},
        "focal_relative_std": 0.1,
        "height_std_m": 0.05,
        "lean_deg": 0.5,
    }
    return FitResult(**(fields | changes))


def test_a_good_fit_gives_no_warning() -> None:
    assert fit_warnings(result(), np.arange(FRAMES), ALL) == []
    assert usable_frames(result()).all()


@pytest.mark.parametrize(
    ("changes", "row", "words"),
    [
        ({"silhouette_iou": 0.75}, 3, "frames 6: the body fits worse"),
        ({"landmark_error_px": 9.0}, 5, "frames 10: the body fits worse"),
        ({"landmark_error_px": 33.0}, 5, "frames 10: the body fits worse"),
        ({"landmark_error_px": np.nan}, 2, "frames 4: no landmarks"),
    ],
)
def test_suspicious_frames_are_reported_and_kept(changes: dict[str, float], row: int, words: str) -> None:
    found = with_outlier(changes, row)
    assert np.flatnonzero(suspicious_frames(found)).tolist() == [row]
    assert usable_frames(found).all()
    (warning,) = fit_warnings(found, 2 * np.arange(FRAMES), ALL)
    assert warning.startswith(words)


def with_outlier(changes: dict[str, float], row: int) -> FitResult:
    """Return a good fit with one value of one frame changed."""
    name, value = next(iter(changes.items()))
    values = getattr(result(), name).copy()
    values[row] = value
    return result(**{name: values})


@pytest.mark.parametrize(
    "changes",
    [{"silhouette_iou": 0.72}, {"silhouette_iou": 0.0}, {"silhouette_iou": np.nan}, {"landmark_error_px": 40.0}],
)
def test_an_unusable_frame_is_reported_with_a_remedy(changes: dict[str, float]) -> None:
    found = with_outlier(changes, 3)
    assert np.flatnonzero(~usable_frames(found)).tolist() == [3]
    assert suspicious_frames(found)[3]
    (warning,) = fit_warnings(found, 2 * np.arange(FRAMES), ALL)
    assert warning.startswith("frames 6: the body does not match the person; 1 frame dropped from the training;")
    assert "masks/" in warning
    (warning,) = fit_warnings(found, 2 * np.arange(FRAMES), np.arange(FRAMES) != 3)
    assert "0 frames dropped" in warning


def test_landmark_errors_are_relative_to_the_height_of_the_person() -> None:
    """A person at twice the distance is half as tall in the image."""
    error_px, root_m = np.full(FRAMES, 20.0), np.tile(np.float32([0, 0, -4]), (FRAMES, 1))
    assert usable_frames(result(landmark_error_px=error_px)).all()
    assert not usable_frames(result(landmark_error_px=error_px, root_translation_m=root_m)).any()


def test_frames_without_a_mask_have_zero_iou() -> None:
    silhouette_iou = np.full(FRAMES, np.nan)
    assert median_silhouette_iou(result(silhouette_iou=silhouette_iou)) == 0.0
    assert not usable_frames(result(silhouette_iou=silhouette_iou)).any()
    silhouette_iou[:7] = 0.9
    assert median_silhouette_iou(result(silhouette_iou=silhouette_iou)) == 0.9
    assert usable_frames(result(silhouette_iou=silhouette_iou)).tolist() == [True] * 7 + [False] * 5


def test_median_ignores_values_that_are_not_finite() -> None:
    assert finite_median(np.array([np.nan, 3.0, 1.0, np.nan, 8.0])) == 3.0
    assert np.isnan(finite_median(np.full(4, np.nan)))
    assert np.isnan(finite_median(np.zeros(0)))


def test_a_rough_fit_is_reported_with_a_remedy() -> None:
    (warning,) = fit_warnings(result(silhouette_iou=np.full(FRAMES, 0.8)), np.arange(FRAMES), ALL)
    assert warning.startswith("the body fits the masks only roughly (median silhouette IoU 0.80)")
    assert "camera.json" in warning


def test_the_worst_rating_wins() -> None:
    legs, silhouette_iou = np.isin(np.arange(FRAMES), [1, 2, 3]), np.full(FRAMES, 0.93)
    silhouette_iou[3] = 0.2
    rating = rate_frames(
        result(left_right_swapped={"legs": legs, "arms": ~ALL}, silhouette_iou=silhouette_iou), np.arange(FRAMES) == 2
    )
    assert [FRAME_RATINGS[number] for number in rating[:5]] == ["", "corrected", "suspicious", "unusable", ""]


def test_overlay_frames_of_a_good_fit_are_evenly_spaced() -> None:
    good = np.zeros(9, dtype=np.int64)
    assert select_overlay_frames(good, np.ones(9), 5).tolist() == [0, 2, 4, 6, 8]
    assert select_overlay_frames(good, np.ones(9), 12).tolist() == list(range(9))


def test_half_of_the_overlay_frames_are_the_worst() -> None:
    rating, silhouette_iou = np.zeros(40, dtype=np.int64), np.full(40, 0.9)
    rating[20:30], rating[33] = 2, 3
    silhouette_iou[[24, 27, 33]] = 0.7, np.nan, 0.8
    shown = select_overlay_frames(rating, silhouette_iou, 6).tolist()
    assert shown == sorted(set(shown))
    assert {24, 27, 33} <= set(shown)
    assert set(shown) - {24, 27, 33} == {0, 18, 39}
    one = select_overlay_frames((np.arange(40) == 33).astype(np.int64), silhouette_iou, 6)
    assert len(one) == 6
    assert np.diff(one).max() <= 10


def test_unreliable_landmarks_count_if_there_are_no_reliable_ones() -> None:
    """Unreliable and wrong: half of the landmarks of frame 0, all of frame 1. Frame 2 has no landmarks."""
    scene, visibility = synthetic_recording(load_anny(), 3), np.ones((3, 33))
    shift_px = np.zeros((3, 33, 2))
    shift_px[0, :20], visibility[0, :20] = 90.0, 0.3
    shift_px[1], visibility[1] = [3.0, 4.0], 0.3
    shift_px[2] = np.nan
    observations = make_observations(
        scene.time_s, scene.landmarks_px + shift_px, visibility, scene.landmarks_world_m, scene.camera
    )
    regressor = landmark_regressor(linearise_body(load_anny(), load_anny().shape_defaults))
    errors_px = landmark_errors_px(regressor, scene.model, scene.state, observations)
    assert errors_px == pytest.approx([0.0, 5.0, np.nan], abs=1e-3, nan_ok=True)


def test_a_supplied_focal_length_that_the_turn_contradicts_is_named() -> None:
    (warning,) = fit_warnings(result(contradicting_focal_log=float(np.log(2.0))), np.arange(FRAMES), ALL)
    assert warning.startswith("the supplied focal length of 500 px contradicts the turn, which shows about 1000 px:")


def test_an_uncertain_focal_length_is_reported_with_a_remedy() -> None:
    (warning,) = fit_warnings(result(focal_relative_std=0.2), np.arange(FRAMES), ALL)
    assert warning.startswith("focal length 500 px has a standard deviation of 20 %:")
    assert "camera.json" in warning


def test_swapped_legs_are_reported() -> None:
    legs = np.arange(FRAMES) > 8
    (warning,) = fit_warnings(result(left_right_swapped={"legs": legs}), np.arange(FRAMES), ALL)
    assert "frames 9-11" in warning
    assert "left and right legs" in warning


def test_observations_are_in_world_axes_and_missing_landmarks_have_zero_confidence() -> None:
    landmarks, world = np.ones((2, 33, 2)), np.tile([0.1, 0.2, 0.3], (2, 33, 1))
    landmarks[0, 5], world[1, 7] = np.nan, np.nan
    observations = make_observations(np.arange(2.0), landmarks, np.ones((2, 33)), world, CAMERA)
    assert np.allclose(observations.landmarks_3d_m[0, 0], [0.1, -0.2, -0.3])
    assert observations.confidence[0, 5] == 0.0
    assert observations.confidence_3d[1, 7] == 0.0
    assert observations.confidence.sum() == 65.0
    assert observations.landmarks_px.isfinite().all()
