"""The whole fit on people whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipeline.avatar.body import load_anny
from pipeline.avatar.fit import FitOptions, FitResult, fit_body
from pipeline.avatar.fit_landmarks import PAIRS, POSE_LANDMARKS, mirror_permutation
from tests.avatar.acting import Act, act, fitted_joints_m, joint_errors_m

FRAMES = 20
SHAPE = {"gender": 0.2, "height": 0.45, "weight": 0.65, "upperleg-length": 0.2, "waist-girth": 0.3}


def options(scene: Act, focal_deviation: float = 0.0, rounds: int = 4) -> FitOptions:
    return FitOptions(scene.model.height_m()[0], focal_deviation, shared_frames=FRAMES, rounds=rounds)


@pytest.fixture(scope="module")
def hurt() -> tuple[Act, FitResult]:
    """A full turn with noise, five frames seen the wrong way round, three frames unseen and one landmark that jumps."""
    scene = act(load_anny(), FRAMES, shape=SHAPE, noise_m=0.008)
    order = mirror_permutation(PAIRS)[:POSE_LANDMARKS]
    scene.landmarks_px[10:13] = scene.landmarks_px[10:13][:, order]
    scene.landmarks_world_m[10:13] = scene.landmarks_world_m[10:13][:, order] * [1.0, 1.0, -1.0]
    scene.landmarks_px[4] = np.nan
    scene.landmarks_world_m[4] = np.nan
    scene.landmarks_px[7, 15] += [60.0, -40.0]
    return scene, fit_body(load_anny(), scene.observations(scene.camera), scene.windows(), options(scene))


def test_joints_are_found_with_known_focal_length(hurt: tuple[Act, FitResult]) -> None:
    scene, result = hurt
    aligned, absolute = joint_errors_m(fitted_joints_m(result, scene), scene.joints_m())
    assert aligned < 0.015
    assert absolute < 0.030
    assert np.median(result.overlap) > 0.95


def test_exchanged_sides_are_mended_in_a_full_turn(hurt: tuple[Act, FitResult]) -> None:
    scene, result = hurt
    assert np.flatnonzero(result.exchanged["whole body"]).tolist() == [10, 11, 12]
    found, true = fitted_joints_m(result, scene), scene.joints_m()
    names = [name for name in result.body.joint_names if name in ("LeftUpLeg", "RightUpLeg")]
    left, right = (list(scene.model.full_joint).index(result.body.joint(name)) for name in sorted(names))
    across = ((found[:, left] - found[:, right]) * (true[:, left] - true[:, right])).sum(-1)
    assert (across > 0).all()


def test_a_frame_without_landmarks_gets_a_pose_and_is_marked(hurt: tuple[Act, FitResult]) -> None:
    scene, result = hurt
    assert np.flatnonzero(np.isnan(result.landmark_error_px)).tolist() == [4]
    aligned, _ = joint_errors_m(fitted_joints_m(result, scene)[4:5], scene.joints_m()[4:5])
    assert aligned < 0.06


def test_fast_motion_is_not_frozen(hurt: tuple[Act, FitResult]) -> None:
    """Accelerations of the hands stay within half of the true ones (root mean square)."""
    scene, result = hurt
    hand = list(scene.model.full_joint).index(result.body.joint("LeftHand"))

    def jitter(joints: torch.Tensor) -> float:
        return float(torch.diff(joints[:, hand], n=2, dim=0).square().mean().sqrt())

    ratio = jitter(fitted_joints_m(result, scene)) / jitter(scene.joints_m())
    assert 0.7 < ratio < 1.5


def test_quaternions_are_unit_and_continuous(hurt: tuple[Act, FitResult]) -> None:
    _, result = hurt
    assert np.allclose(np.linalg.norm(result.rotations_wxyz, axis=-1), 1.0, atol=1e-5)
    assert ((result.rotations_wxyz[1:] * result.rotations_wxyz[:-1]).sum(-1) >= 0).all()


def test_unknown_focal_length_is_found() -> None:
    scene = act(load_anny(), FRAMES, shape=SHAPE, noise_m=0.004)
    start = replace(scene.camera, fx=384.0, fy=384.0)
    result = fit_body(load_anny(), scene.observations(start), scene.windows(), options(scene, 0.5, rounds=6))
    assert result.camera.fx == pytest.approx(scene.camera.fx, rel=0.10)
    assert 0.0 < result.focal_deviation < 0.3
    aligned, _ = joint_errors_m(fitted_joints_m(result, scene), scene.joints_m())
    assert aligned < 0.025


def test_a_picture_cut_off_centre_tells_its_principal_point() -> None:
    """A fifth of the width is missing on the left; the camera to start from has its point in the middle."""
    scene = act(load_anny(), FRAMES, shape=SHAPE, noise_m=0.004)
    left_px = 52
    cut = scene.camera.cropped(left_px, 0, scene.camera.width - left_px, scene.camera.height)
    start = replace(cut, cx=0.5 * cut.width, cy=0.5 * cut.height)
    seen = scene.observations(scene.camera)
    seen = replace(seen, camera=start, landmarks_px=seen.landmarks_px - seen.landmarks_px.new_tensor([left_px, 0]))
    windows = [window and replace(window, left_px=window.left_px - left_px) for window in scene.windows()]
    found = [
        fit_body(load_anny(), seen, windows, replace(options(scene, 0.2, rounds=6), centre_deviation=deviation))
        for deviation in (0.0, 0.1)
    ]
    assert found[0].camera.cx == start.cx
    assert abs(found[1].camera.cx - cut.cx) < 0.4 * abs(start.cx - cut.cx)
    error_m = [joint_errors_m(fitted_joints_m(result, scene), scene.joints_m())[0] for result in found]
    assert error_m[1] < error_m[0]


def test_the_same_input_gives_the_same_bytes() -> None:
    scene = act(load_anny(), 4)
    results = [
        fit_body(load_anny(), scene.observations(scene.camera), scene.windows(), options(scene, rounds=1))
        for _ in range(2)
    ]
    assert results[0].rotations_wxyz.tobytes() == results[1].rotations_wxyz.tobytes()
    assert results[0].body.vertices.tobytes() == results[1].body.vertices.tobytes()


def test_too_few_landmarks_are_refused() -> None:
    scene = act(load_anny(), 4)
    scene.landmarks_px[2:] = np.nan
    with pytest.raises(ValueError, match="fewer than 3 frames"):
        fit_body(load_anny(), scene.observations(scene.camera), scene.windows(), options(scene))
