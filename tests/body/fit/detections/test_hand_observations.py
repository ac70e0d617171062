"""Hand observations: hands from forward kinematics with known flexion, and detections with known errors."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipeline.body.body import AnnyBody, load_anny
from pipeline.body.fit.detections.hand_observations import (
    MAX_CURL_RAD,
    MAX_WRIST_DISTANCE_M,
    MIN_HAND_FRAMES,
    filter_hand_detections,
    finger_curls_rad,
    finger_flexion_rad,
    hand_landmarks,
    rest_hand_points_m,
)
from pipeline.body.fit.diagnostics import make_observations
from pipeline.body.fit.energy import EnergyParameters, Objective, compute_px_per_m
from pipeline.body.fit.landmark_regressor import (
    FACE_MESH_START,
    HAND_LANDMARKS,
    LANDMARKS,
    POSE_LANDMARK_COUNT,
    landmark_regressor,
)
from pipeline.body.fit.levenberg_marquardt import minimise
from pipeline.body.fit.linear_body import (
    ACTIVE_JOINTS,
    FINGERS,
    RELAXED_CURL_RAD,
    finger_curl_rotations,
    linearise_body,
    relaxed_curls_rad,
)
from pipeline.body.fit.posed_points import pose_points, pose_skeleton
from pipeline.body.fit.prior.priors import pose_prior, shape_prior
from pipeline.body.settings import FitSettings
from pipeline.body.smpl import SmplBody
from pipeline.capture.hand_detector import N_HAND_LANDMARKS, HandLandmarks, undetected_hands
from pipeline.geometry.camera import project
from pipeline.geometry.rotation import axis_angle_to_matrix
from pipeline.geometry.skinning import forward_kinematics
from tests.body.acting import synthetic_recording
from tests.body.smpl_sample import sample_arrays

FRAMES = 12
CURLS = np.array([[0.1, 0.3, 0.5, 0.7], [0.6, 0.4, 0.2, 0.0]])


def posed_hand_m(body: AnnyBody, curls_rad: np.ndarray, side: int) -> np.ndarray:
    """Return 21 points of a hand with bent fingers; the last bone of a finger repeats the one before it."""
    finger_rotations = finger_curl_rotations(body, curls_rad)
    _, joints = body.rest_pose(body.shape_defaults)
    joint_to_world = forward_kinematics(finger_rotations.float()[None], joints[None, 0], joints, body.parents)[
        0
    ].double()
    name = ("LeftHand", "RightHand")[side]
    points = np.zeros((N_HAND_LANDMARKS, 3))
    points[0] = joint_to_world[body.joint_names.index(name), :3, 3]
    for place, finger in enumerate(FINGERS):
        rows = [body.joint_names.index(f"{name}{finger}{bone}") for bone in (1, 2, 3)]
        points[5 + 4 * place : 8 + 4 * place] = joint_to_world[rows, :3, 3]
        rest = (joints[rows[2]] - joints[rows[1]]).double()
        points[8 + 4 * place] = points[7 + 4 * place] + (joint_to_world[rows[2], :3, :3] @ rest).numpy()
    return points


def simulate_hands(body: AnnyBody, curls_rad: np.ndarray, frames: int, noise_m: float = 0.0) -> HandLandmarks:
    """Return detections of both hands at 250 px per metre, with another orientation in every frame."""
    random = np.random.default_rng(0)
    turns = axis_angle_to_matrix(torch.from_numpy(random.normal(size=(frames, 3)))).numpy()
    points = np.stack([posed_hand_m(body, curls_rad, side) for side in range(2)])
    points = (points - points.mean(1, keepdims=True)) @ turns[:, None].swapaxes(-1, -2)
    points += noise_m * random.normal(size=points.shape)
    return HandLandmarks(100.0 + 250.0 * points[..., :2], points, np.full((frames, 2), 0.9))


def pose_px(hands: HandLandmarks) -> np.ndarray:
    """Return pose landmarks with the wrists of the hands."""
    landmarks_px = np.zeros((len(hands.handedness_score), 33, 2))
    landmarks_px[:, [15, 16]] = hands.landmarks_px[:, :, 0]
    return landmarks_px


def test_finger_curls_are_estimated_from_rotating_hands() -> None:
    body = load_anny()
    hands = simulate_hands(body, CURLS, 40, noise_m=0.001)
    hands.landmarks_m[:6] = hands.landmarks_m[:6, :, ::-1]  # outliers
    reliable = filter_hand_detections(hands, pose_px(hands))
    assert (reliable.handedness_score == 0.9).all()
    np.testing.assert_allclose(finger_curls_rad(body, reliable), CURLS, atol=0.06)


def test_straight_fingers_have_zero_flexion_and_a_fist_positive() -> None:
    body = load_anny()
    for side in range(2):
        rest, fist = rest_hand_points_m(body, side), posed_hand_m(body, np.full((2, 4), 1.0), side)
        assert np.abs(finger_flexion_rad(rest, side)[:, 2]).max() < 1e-6
        np.testing.assert_allclose(finger_flexion_rad(fist, side) - finger_flexion_rad(rest, side), 1.0, atol=0.15)


@pytest.mark.parametrize("frame_count", [0, MIN_HAND_FRAMES - 1])
def test_a_rarely_detected_hand_keeps_the_relaxed_curl(frame_count: int) -> None:
    """The curl of one hand does not depend on the detections of the other."""
    body = load_anny()
    hands = simulate_hands(body, CURLS, FRAMES)
    hands.handedness_score[MIN_HAND_FRAMES:, 0] = 0.0
    hands.handedness_score[frame_count:, 1] = 0.0
    left, right = finger_curls_rad(body, hands)
    np.testing.assert_allclose(left, CURLS[0], atol=0.06)
    np.testing.assert_array_equal(right, np.full(4, RELAXED_CURL_RAD))


@pytest.mark.parametrize(("true_rad", "found_rad"), [(-0.6, 0.0), (1.7, MAX_CURL_RAD)])
def test_finger_curls_are_clamped(true_rad: float, found_rad: float) -> None:
    body = load_anny()
    hands = simulate_hands(body, np.full((2, 4), true_rad), MIN_HAND_FRAMES)
    np.testing.assert_array_equal(finger_curls_rad(body, hands), np.full((2, 4), found_rad))


def test_a_body_without_fingers_has_the_relaxed_curl() -> None:
    hands = simulate_hands(load_anny(), CURLS, FRAMES)
    body = SmplBody(sample_arrays(24))
    np.testing.assert_array_equal(finger_curls_rad(body, hands), relaxed_curls_rad())


def test_hands_of_the_other_side_or_away_from_the_wrist_are_not_reliable() -> None:
    hands = simulate_hands(load_anny(), CURLS, 4)
    hands.handedness_score[1, 0] = 0.4
    landmarks_px = pose_px(hands)
    landmarks_px[2, 16, 0] += 250.0 * 1.1 * MAX_WRIST_DISTANCE_M
    landmarks_px[3, 15, 0] += 250.0 * 0.9 * MAX_WRIST_DISTANCE_M
    trust = filter_hand_detections(hands, landmarks_px).handedness_score
    np.testing.assert_array_equal(trust == 0.0, [[False, False], [True, False], [False, True], [False, False]])
    assert (filter_hand_detections(undetected_hands(4), landmarks_px).handedness_score == 0.0).all()


def test_hand_landmarks_are_in_the_order_of_the_fit() -> None:
    hands = simulate_hands(load_anny(), CURLS, 3)
    world = np.random.default_rng(0).normal(size=(3, 33, 3))
    hands.handedness_score[:, 0] = 0.7
    pixels, places, weights = hand_landmarks(hands, world)
    indices = [index for landmark in LANDMARKS for index in landmark.indices]
    indices = [index for index in indices if POSE_LANDMARK_COUNT <= index < FACE_MESH_START]
    assert indices == list(range(POSE_LANDMARK_COUNT, POSE_LANDMARK_COUNT + pixels.shape[1]))
    for place, (point, side) in enumerate((point, side) for point in HAND_LANDMARKS for side in range(2)):
        np.testing.assert_array_equal(pixels[:, place], hands.landmarks_px[:, side, point])
        np.testing.assert_array_equal(weights[:, place], hands.handedness_score[:, side])
        from_wrist = hands.landmarks_m[:, side, point] - hands.landmarks_m[:, side, 0]
        np.testing.assert_allclose(places[:, place] - world[:, 15 + side], from_wrist, atol=1e-12)


def test_hand_landmarks_determine_the_wrist_rotation() -> None:
    """The wrists start straight; pose landmarks of the knuckles have low confidence, hand landmarks do not."""
    body, rows = load_anny(), [ACTIVE_JOINTS.index(name) for name in ("LeftHand", "RightHand")]
    scene = synthetic_recording(body, 3, turn_rad=0.5, wrists_rad=0.3)
    start = replace(scene.state, rotations=scene.state.rotations.clone())
    start.rotations[:, rows] = torch.eye(3, dtype=torch.float64)
    visibility = np.ones((3, 33))
    visibility[:, 17:23] = 0.0
    priors = pose_prior(scene.model), shape_prior(body.shape_names, body.shape_defaults)
    regressor = landmark_regressor(linearise_body(body, body.shape_defaults))
    errors_px = []
    for hands in (None, scene.hands):
        observations = make_observations(
            scene.time_s, scene.landmarks_px, visibility, scene.landmarks_world_m, scene.camera, hands
        )
        weights = EnergyParameters(free_shape=False, hand_std_m=FitSettings.fitted_hand_std_m)
        objective = Objective(
            scene.model, regressor, *priors, observations, weights, compute_px_per_m(start, scene.camera)
        )
        state, _ = minimise(start, objective, objective.retract, 12)
        skeleton = pose_skeleton(scene.model, state.rotations, state.root_m)
        points = pose_points(scene.model, skeleton, regressor.points(scene.model, state.landmark_offsets_m)).world_m
        found_px = project(points[:, POSE_LANDMARK_COUNT:FACE_MESH_START].flatten(0, 1), scene.camera)[0].reshape(
            3, -1, 2, 2
        )
        true_px = scene.hands.landmarks_px[:, :, list(HAND_LANDMARKS)].swapaxes(1, 2)
        errors_px.append(float(np.linalg.norm(found_px.numpy() - true_px, axis=-1).max()))
    assert errors_px[0] > 2.5
    assert errors_px[1] < 1.5


def test_finger_curl_is_applied_to_every_finger_joint() -> None:
    body = load_anny()
    model = linearise_body(body, body.shape_defaults, CURLS)
    for side, name in enumerate(("LeftHand", "RightHand")):
        for finger, curl in zip(FINGERS, CURLS[side], strict=True):
            for bone in (1, 2, 3):
                rotation = model.finger_rotations[body.joint_names.index(f"{name}{finger}{bone}")]
                angle = torch.acos((torch.trace(rotation) - 1.0).clamp(-2, 2) / 2.0)
                assert float(angle) == pytest.approx(curl, abs=1e-4)
