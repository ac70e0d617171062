"""The whole fit on synthetic recordings with known ground truth."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipeline.body.body import Motion, canonical_to_world, load_anny
from pipeline.body.fit.fit import fit_body
from pipeline.body.fit.linear_body import ACTIVE_JOINTS
from pipeline.body.fit.options import FitOptions
from pipeline.body.fit.result import FitResult
from pipeline.body.fit.silhouette_icp import rasterise_in_window
from pipeline.body.fit.terms import FACE_LANDMARK_COUNT
from pipeline.body.overlay import pose_vertices
from pipeline.geometry.rotation import axis_angle_to_matrix
from tests.body.acting import (
    SyntheticRecording,
    fitted_joint_to_world,
    fitted_joints_m,
    joint_errors_m,
    simulate_detections,
    swap_left_right,
    synthetic_recording,
)

FRAMES = 20
SHAPE = {"gender": 0.2, "height": 0.45, "weight": 0.65, "upperleg-length": 0.2, "waist-girth": 0.3}


def options(scene: SyntheticRecording, focal_relative_std: float = 0.0, rounds: int = 4) -> FitOptions:
    return FitOptions(scene.model.height_m()[0], focal_relative_std, shared_frames=FRAMES, rounds=rounds)


JUMP = 7
"""The frame in which the detection of the left wrist is off by about 40 cm."""


@pytest.fixture(scope="module")
def corrupted_fit() -> tuple[SyntheticRecording, FitResult]:
    """Return the fit of a noisy full turn: three frames swapped, one without landmarks, one landmark that jumps."""
    scene = synthetic_recording(load_anny(), FRAMES, shape=SHAPE, noise_m=0.008)
    swap_left_right(scene, slice(10, 13))
    scene.landmarks_px[4] = np.nan
    scene.landmarks_world_m[4] = np.nan
    scene.landmarks_px[JUMP, 15] += [60.0, -40.0]
    return scene, fit_body(load_anny(), scene.observations(scene.camera), scene.windows(), options(scene))


def test_joints_are_accurate_with_known_focal_length(corrupted_fit: tuple[SyntheticRecording, FitResult]) -> None:
    scene, result = corrupted_fit
    aligned, absolute = joint_errors_m(fitted_joints_m(result, scene), scene.joints_m())
    assert aligned < 0.015
    assert absolute < 0.030
    assert np.median(result.silhouette_iou) > 0.95


def test_left_right_swaps_are_corrected_in_a_full_turn(corrupted_fit: tuple[SyntheticRecording, FitResult]) -> None:
    scene, result = corrupted_fit
    assert np.flatnonzero(result.left_right_swapped["whole body"]).tolist() == [10, 11, 12]
    found, true = fitted_joints_m(result, scene), scene.joints_m()
    names = [name for name in result.body.joint_names if name in ("LeftUpLeg", "RightUpLeg")]
    left, right = (list(scene.model.full_joint_indices).index(result.body.joint(name)) for name in sorted(names))
    across = ((found[:, left] - found[:, right]) * (true[:, left] - true[:, right])).sum(-1)
    assert (across > 0).all()


def test_a_frame_without_landmarks_gets_a_pose_and_is_marked(
    corrupted_fit: tuple[SyntheticRecording, FitResult],
) -> None:
    scene, result = corrupted_fit
    assert np.flatnonzero(np.isnan(result.landmark_error_px)).tolist() == [4]
    aligned, _ = joint_errors_m(fitted_joints_m(result, scene)[4:5], scene.joints_m()[4:5])
    assert aligned < 0.06


def test_an_outlier_landmark_does_not_move_its_joint(corrupted_fit: tuple[SyntheticRecording, FitResult]) -> None:
    scene, result = corrupted_fit
    hand = ACTIVE_JOINTS.index("LeftHand")
    error_m = (fitted_joints_m(result, scene) - scene.joints_m())[:, hand].norm(dim=-1)
    print(f"left wrist, mm: {error_m.mul(1000).round().int().tolist()}")
    assert error_m[JUMP] < 0.02


def test_the_body_stays_inside_its_mask(corrupted_fit: tuple[SyntheticRecording, FitResult]) -> None:
    scene, result = corrupted_fit
    motion = Motion(np.arange(FRAMES), scene.time_s, result.rotations_wxyz, result.root_translation_m)
    faces = torch.as_tensor(result.body.faces)
    spill = []
    for window, transforms in zip(scene.windows(), canonical_to_world(result.body, motion), strict=True):
        assert window is not None
        drawn = rasterise_in_window(pose_vertices(result.body, transforms), faces, result.camera, window).face_id >= 0
        spill.append((drawn & ~window.mask).sum() / window.mask.sum())
    print(f"outside the mask, %: {np.round(100 * np.array(spill), 1).tolist()}")
    assert np.median(spill) < 0.015
    assert max(spill) < 0.03


@pytest.mark.slow
def test_fast_arm_motion_is_tracked() -> None:
    """Arms swing by 0.8 rad at 2.5 Hz, recorded at 30 frames per second; the motion prior must not damp them."""
    time_s = np.arange(18) / 30.0
    angles = torch.zeros(len(time_s), 3, dtype=torch.float64)
    angles[:, 2] = 0.8 * torch.sin(2 * torch.pi * 2.5 * torch.tensor(time_s))
    turns = {f"{side}Arm": axis_angle_to_matrix(sign * angles) for side, sign in (("Left", 1.0), ("Right", -1.0))}
    scene = recording_with_rotations(turns, time_s, turn_rad=0.6)
    result = fit_body(load_anny(), scene.observations(scene.camera), scene.windows(), options(scene, rounds=1))
    hands = [ACTIVE_JOINTS.index(f"{side}Hand") for side in ("Left", "Right")]
    found, true = (joints[:, hands, 1] for joints in (fitted_joints_m(result, scene), scene.joints_m()))
    print(f"swing over the true one {(found.std(0) / true.std(0)).tolist()}, error {(found - true).abs().max()} m")
    assert ((found.std(0) / true.std(0) - 1).abs() < 0.1).all()
    assert (found - true).abs().max() < 0.06


@pytest.mark.slow
def test_face_landmarks_on_the_back_of_a_head_are_ignored() -> None:
    """The person is seen from behind (126 to 206 degrees); the detector invents a face towards the camera."""
    away = torch.linspace(2.2, 3.6, 8, dtype=torch.float64)
    hips = axis_angle_to_matrix(torch.stack([torch.zeros(8), away, torch.zeros(8)], dim=1).double())
    straight = torch.eye(3, dtype=torch.float64).repeat(8, 1, 1)
    scene = recording_with_rotations({"Hips": hips, "Head": straight}, np.arange(8) / 10.0)
    turn_faces_to_camera(scene)
    result = fit_body(load_anny(), scene.observations(scene.camera), scene.windows(), options(scene, rounds=1))
    head = fitted_joint_to_world(result, scene)[:, ACTIVE_JOINTS.index("Head"), :3, :3]
    error = (torch.einsum("nij,nij->n", head, hips) / 2 - 0.5).clamp(-1, 1).arccos().rad2deg()
    print(f"head, degrees: {error.tolist()}")
    assert error.max() < 10.0


def recording_with_rotations(
    turns: dict[str, torch.Tensor], time_s: np.ndarray, turn_rad: float = 0.0
) -> SyntheticRecording:
    """Return the synthetic recording with other rotations of some joints."""
    body = load_anny()
    scene = synthetic_recording(body, len(time_s), turn_rad=turn_rad)
    rotations = scene.state.rotations.clone()
    for name, turn in turns.items():
        rotations[:, ACTIVE_JOINTS.index(name)] = turn
    state = replace(scene.state, rotations=rotations)
    return simulate_detections(body, scene.model, state, scene.camera, time_s, noise_m=0.008)


def turn_faces_to_camera(scene: SyntheticRecording) -> None:
    """Rotate the face landmarks about the vertical axis between the ears until the nose points at the camera."""
    face_m = scene.landmarks_world_m[:, :FACE_LANDMARK_COUNT]
    middle_m = face_m[:, 7:9].mean(1, keepdims=True)
    x, y, z = np.moveaxis(face_m - middle_m, -1, 0)
    away = np.arctan2(x[:, :1], -z[:, :1])
    turned_m = middle_m + np.stack([x * np.cos(away) + z * np.sin(away), y, z * np.cos(away) - x * np.sin(away)], -1)
    px_per_m = scene.camera.fx / -scene.state.root_m[:, 2].numpy()
    scene.landmarks_px[:, :FACE_LANDMARK_COUNT] += (turned_m - face_m)[..., :2] * px_per_m[:, None, None]
    scene.landmarks_world_m[:, :FACE_LANDMARK_COUNT] = turned_m


def test_accelerations_match_the_true_ones(corrupted_fit: tuple[SyntheticRecording, FitResult]) -> None:
    """Accelerations of the hands stay within half of the true ones (root mean square)."""
    scene, result = corrupted_fit
    hand = list(scene.model.full_joint_indices).index(result.body.joint("LeftHand"))

    def jitter(joints: torch.Tensor) -> float:
        return float(torch.diff(joints[:, hand], n=2, dim=0).square().mean().sqrt())

    ratio = jitter(fitted_joints_m(result, scene)) / jitter(scene.joints_m())
    assert 0.7 < ratio < 1.5


def test_quaternions_are_unit_and_continuous(corrupted_fit: tuple[SyntheticRecording, FitResult]) -> None:
    _, result = corrupted_fit
    assert np.allclose(np.linalg.norm(result.rotations_wxyz, axis=-1), 1.0, atol=1e-5)
    assert ((result.rotations_wxyz[1:] * result.rotations_wxyz[:-1]).sum(-1) >= 0).all()


@pytest.mark.slow
def test_unknown_focal_length_is_estimated() -> None:
    scene = synthetic_recording(load_anny(), FRAMES, shape=SHAPE, noise_m=0.004)
    start = replace(scene.camera, fx=384.0, fy=384.0)
    result = fit_body(load_anny(), scene.observations(start), scene.windows(), options(scene, 0.5, rounds=6))
    assert result.camera.fx == pytest.approx(scene.camera.fx, rel=0.10)
    assert 0.0 < result.focal_relative_std < 0.3
    aligned, _ = joint_errors_m(fitted_joints_m(result, scene), scene.joints_m())
    assert aligned < 0.025


@pytest.mark.slow
def test_principal_point_of_an_off_centre_crop_is_estimated() -> None:
    """A fifth of the width is missing on the left; the camera to start from has its point in the middle."""
    scene = synthetic_recording(load_anny(), FRAMES, shape=SHAPE, noise_m=0.004)
    left_px = 52
    cut = scene.camera.cropped(left_px, 0, scene.camera.width - left_px, scene.camera.height)
    start = replace(cut, cx=0.5 * cut.width, cy=0.5 * cut.height)
    observations = scene.observations(scene.camera)
    observations = replace(
        observations,
        camera=start,
        landmarks_px=observations.landmarks_px - observations.landmarks_px.new_tensor([left_px, 0]),
    )
    windows = [window and replace(window, left_px=window.left_px - left_px) for window in scene.windows()]
    found = [
        fit_body(
            load_anny(),
            observations,
            windows,
            replace(options(scene, 0.2, rounds=6), principal_point_relative_std=deviation),
        )
        for deviation in (0.0, 0.1)
    ]
    assert found[0].camera.cx == start.cx
    assert abs(found[1].camera.cx - cut.cx) < 0.4 * abs(start.cx - cut.cx)
    error_m = [joint_errors_m(fitted_joints_m(result, scene), scene.joints_m())[0] for result in found]
    assert error_m[1] < error_m[0]


@pytest.mark.slow
def test_the_same_input_gives_the_same_bytes() -> None:
    scene = synthetic_recording(load_anny(), 4)
    results = [
        fit_body(load_anny(), scene.observations(scene.camera), scene.windows(), options(scene, rounds=1))
        for _ in range(2)
    ]
    assert results[0].rotations_wxyz.tobytes() == results[1].rotations_wxyz.tobytes()
    assert results[0].body.vertices.tobytes() == results[1].body.vertices.tobytes()


def test_too_few_landmarks_are_refused() -> None:
    scene = synthetic_recording(load_anny(), 4)
    scene.landmarks_px[2:] = np.nan
    with pytest.raises(ValueError, match="fewer than 3 frames"):
        fit_body(load_anny(), scene.observations(scene.camera), scene.windows(), options(scene))
