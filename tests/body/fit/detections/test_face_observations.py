"""Face observations: faces of a known head, turned by known angles."""

import numpy as np
import torch

from pipeline.body.body import load_anny
from pipeline.body.fit.detections.face_observations import (
    FACE_MESH_POINTS,
    MAX_DISTANCE_M,
    face_landmarks,
    facing_cosine,
)
from pipeline.body.fit.diagnostics import make_observations
from pipeline.body.fit.energy import EnergyParameters, Objective, compute_px_per_m
from pipeline.body.fit.landmark_regressor import FACE_MESH_START, LANDMARKS, landmark_regressor
from pipeline.body.fit.levenberg_marquardt import minimise
from pipeline.body.fit.linear_body import ACTIVE_JOINTS, linearise_body
from pipeline.body.fit.posed_points import pose_points, pose_skeleton
from pipeline.body.fit.prior.priors import pose_prior, shape_prior
from pipeline.body.settings import FitSettings
from pipeline.capture.face_detector import undetected_face
from pipeline.geometry.camera import project
from tests.body.acting import SyntheticRecording, synthetic_recording

HEAD = ACTIVE_JOINTS.index("Head")


def head_facing_cosine(scene: SyntheticRecording) -> np.ndarray:
    """Cosine between the forward axis of the head and the direction to the camera."""
    skeleton = pose_skeleton(scene.model, scene.state.rotations, scene.state.root_m)
    to_camera = torch.nn.functional.normalize(
        torch.as_tensor(scene.camera.centre_m()).double() - skeleton.position_m[:, HEAD], dim=-1
    )
    return (skeleton.rotation[:, HEAD, :, 2] * to_camera).sum(-1).numpy()


def test_facing_cosine_is_that_of_the_head() -> None:
    """The points of a face lie 15 degrees off a vertical plane, so it is compared with the frontal frame."""
    scene = synthetic_recording(load_anny(), 24, turn_rad=2.0 * np.pi)
    expected, found = head_facing_cosine(scene), facing_cosine(scene.faces_px)
    assert found[expected > 0.95].min() > 0.85
    assert found[expected < -0.95].max() < -0.85
    assert np.abs(found - expected).max() < 0.3


def test_only_faces_that_look_at_the_camera_are_reliable() -> None:
    scene = synthetic_recording(load_anny(), 24, turn_rad=2.0 * np.pi)
    _, confidence = face_landmarks(scene.faces_px, scene.landmarks_px, scene.landmarks_world_m)
    expected = head_facing_cosine(scene)
    assert (confidence[expected > 0.9] == 1.0).all()
    assert (confidence[expected < 0.3] == 0.0).all()


def test_a_face_away_from_that_of_the_pose_is_not_reliable() -> None:
    scene = synthetic_recording(load_anny(), 2, turn_rad=0.0)
    px_per_m = compute_px_per_m(scene.state, scene.camera).numpy()
    for ratio, reliable in ((0.5, True), (1.5, False)):
        faces_px = scene.faces_px + [ratio * MAX_DISTANCE_M * px_per_m.mean(), 0.0, 0.0]
        _, confidence = face_landmarks(faces_px, scene.landmarks_px, scene.landmarks_world_m)
        assert bool(confidence.all()) == reliable
    _, confidence = face_landmarks(undetected_face(2), scene.landmarks_px, scene.landmarks_world_m)
    assert not confidence.any()


def test_a_face_that_is_found_on_the_back_of_a_head_is_not_reliable() -> None:
    """Its eyes are where those of the pose are, but for left and right: within the distance that is allowed."""
    scene = synthetic_recording(load_anny(), 24, turn_rad=2.0 * np.pi)
    expected = head_facing_cosine(scene)
    front = int(np.argmax(expected))
    middle_px = scene.landmarks_px[:, 1:11].mean(axis=1)
    faces_px = scene.faces_px[front] + np.pad(middle_px - middle_px[front], ((0, 0), (0, 1)))[:, None]
    _, confidence = face_landmarks(faces_px, scene.landmarks_px, scene.landmarks_world_m)
    assert (confidence[expected > 0.9] == 1.0).all()
    assert (confidence[expected < -0.3] == 0.0).all()


def test_points_are_in_the_order_of_the_landmarks() -> None:
    indices = [index for landmark in LANDMARKS for index in landmark.indices if index >= FACE_MESH_START]
    assert indices == list(range(FACE_MESH_START, FACE_MESH_START + len(FACE_MESH_POINTS)))
    scene = synthetic_recording(load_anny(), 2, turn_rad=0.0)
    points_px, _ = face_landmarks(scene.faces_px, scene.landmarks_px, scene.landmarks_world_m)
    left_px, right_px = points_px[:, 0:6:2, 0], points_px[:, 1:6:2, 0]
    assert (left_px > right_px).all()


def test_the_face_corrects_a_pose_detector_that_shifts_it() -> None:
    """The pose's face points are 4 cm too low, as with hair over the forehead: without face landmarks the head nods."""
    body = load_anny()
    scene = synthetic_recording(body, 3, turn_rad=0.3)
    landmarks_px = scene.landmarks_px.copy()
    landmarks_px[:, :11, 1] += 8.0
    regressor = landmark_regressor(linearise_body(body, body.shape_defaults))
    priors = pose_prior(scene.model), shape_prior(body.shape_names, body.shape_defaults)
    weights = EnergyParameters(
        free_shape=False,
        landmark_std_m=FitSettings.silhouette_landmark_std_m,
        face_std_m=FitSettings.fitted_face_std_m,
    )
    errors_px = []
    for faces_px in (None, scene.faces_px):
        observations = make_observations(
            scene.time_s, landmarks_px, np.ones((3, 33)), scene.landmarks_world_m, scene.camera, None, faces_px
        )
        objective = Objective(
            scene.model, regressor, *priors, observations, weights, compute_px_per_m(scene.state, scene.camera)
        )
        state, _ = minimise(scene.state, objective, objective.retract, 12)
        skeleton = pose_skeleton(scene.model, state.rotations, state.root_m)
        points = pose_points(scene.model, skeleton, regressor.points(scene.model, state.landmark_offsets_m)).world_m
        found_px, _ = project(points[:, FACE_MESH_START:].flatten(0, 1), scene.camera)
        true_px = scene.faces_px[:, FACE_MESH_POINTS, :2].reshape(-1, 2)
        errors_px.append(float(np.linalg.norm(found_px.numpy() - true_px, axis=-1).max()))
    assert errors_px[0] > 3.0
    assert errors_px[1] < 1.5
