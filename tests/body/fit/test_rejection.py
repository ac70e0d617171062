"""Frames that show someone else are found, and do not change the fit of the others."""

import numpy as np
import pytest

from pipeline.body.body import load_anny
from pipeline.body.fit import rejection
from pipeline.body.fit.options import FitOptions
from pipeline.body.fit.rejection import MAX_REJECTED_SHARE, fit_body_without_others, frames_of_others
from pipeline.body.fit.result import FitResult
from pipeline.body.fit.silhouette_icp import MaskWindow, crop_mask_window
from pipeline.core.progress import take_warnings
from tests.body.acting import SyntheticRecording, fitted_joints_m, joint_errors_m, synthetic_recording
from tests.body.fit.test_diagnostics import CAMERA, FRAMES, result

PASSING = slice(8, 12)
"""Frames of a turn of 24 in which the detector takes a passer-by for the person."""
TURN_FRAMES, SHIFT_PX = 24, 40


def passed_by() -> tuple[SyntheticRecording, list[MaskWindow | None]]:
    """Landmarks and masks of a turn in which someone nearer, 1.4 times as large, walks beside the person."""
    scene = synthetic_recording(load_anny(), TURN_FRAMES)
    other = synthetic_recording(load_anny(), TURN_FRAMES, focal_px=1.4 * scene.camera.fx, turn_rad=0.5)
    scene.landmarks_px[PASSING] = other.landmarks_px[PASSING] + [SHIFT_PX, 0.0]
    scene.landmarks_world_m[PASSING] = other.landmarks_world_m[PASSING]
    windows = scene.windows()
    windows[PASSING] = [crop_mask_window(np.roll(mask, SHIFT_PX, axis=1)) for mask in other.masks()[PASSING]]
    return scene, windows


def iou(*bad: int, suspicious: tuple[int, ...] = ()) -> np.ndarray:
    """IoU of frames that match, except these."""
    values = np.full(FRAMES, 0.93)
    values[list(bad)] = 0.6
    values[list(suspicious)] = 0.8
    return values


@pytest.mark.slow
def test_a_passer_by_does_not_change_camera_and_poses() -> None:
    """With the passer-by in the fit, the focal length is 1.4 times the true one and the person 0.9 m farther away."""
    scene, windows = passed_by()
    options = FitOptions(scene.model.height_m()[0], 0.5, shared_frames=12, rounds=3)
    take_warnings()
    found = fit_body_without_others(load_anny(), scene.observations(scene.camera), windows, options)
    assert take_warnings()[0].endswith("frames do not match the body; it is fitted again without them")
    assert found.camera.fx == pytest.approx(scene.camera.fx, rel=0.05)
    _, absolute_m = joint_errors_m(fitted_joints_m(found, scene), scene.joints_m())
    assert absolute_m < 0.1
    rejected = np.flatnonzero(found.silhouette_iou == 0.0)
    # The first fit leads smoothly to the passer-by and back, so that up to two frames on either side do not match it.
    assert set(range(TURN_FRAMES)[PASSING]) <= set(rejected) <= set(range(PASSING.start - 2, PASSING.stop + 2))


def test_suspicious_frames_beside_an_unusable_one_belong_to_it() -> None:
    found = frames_of_others(result(silhouette_iou=iou(5, suspicious=(4, 6, 8))))
    assert np.flatnonzero(found).tolist() == [4, 5, 6]
    assert not frames_of_others(result(silhouette_iou=iou(suspicious=(4, 6, 8)))).any()


def test_frames_without_landmarks_are_not_others() -> None:
    error_px = np.full(FRAMES, 2.0)
    error_px[5] = np.nan
    assert not frames_of_others(result(silhouette_iou=iou(5), landmark_error_px=error_px)).any()


def count_fits(monkeypatch: pytest.MonkeyPatch, first: FitResult) -> tuple[int, FitResult]:
    """Return how often the body is fitted if the first result is this, and the returned result."""
    seen = []

    def fit(body: object, observations: object, windows: list, *rest: object) -> FitResult:
        seen.append((observations, windows))
        return first if len(seen) == 1 else result()

    monkeypatch.setattr(rejection, "fit_body", fit)
    windows: list[MaskWindow | None] = [crop_mask_window(np.full((4, 4), 255, np.uint8))] * FRAMES
    observations = synthetic_recording(load_anny(), FRAMES).observations(CAMERA)
    found = fit_body_without_others(load_anny(), observations, windows, FitOptions())
    for kept, left in seen[1:]:
        gone = np.array([window is None for window in left])
        np.testing.assert_array_equal((kept.confidence == 0.0).all(1).numpy(), gone)
        np.testing.assert_array_equal((kept.confidence_3d == 0.0).all(1).numpy(), gone)
        np.testing.assert_array_equal(found.silhouette_iou == 0.0, gone)
    return len(seen), found


def test_the_body_is_fitted_again_only_if_a_few_frames_do_not_match(monkeypatch: pytest.MonkeyPatch) -> None:
    many = range(int(MAX_REJECTED_SHARE * FRAMES) + 1)
    assert count_fits(monkeypatch, result())[0] == 1
    assert count_fits(monkeypatch, result(silhouette_iou=iou(*many)))[0] == 1
    assert count_fits(monkeypatch, result(silhouette_iou=iou(5)))[0] == 2
