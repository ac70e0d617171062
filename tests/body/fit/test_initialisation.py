from dataclasses import replace
from functools import cache

import numpy as np
import torch

from pipeline.body.body import load_anny
from pipeline.body.fit.initialisation import (
    facing_yaw_rad,
    has_torso_landmarks,
    initial_state,
    interpolated_state,
    solve_root_position,
    torso_rotations,
)
from pipeline.body.fit.landmark_regressor import LANDMARK_OFFSET_COUNT, landmark_regressor
from pipeline.body.fit.linear_body import linearise_body
from pipeline.body.fit.posed_points import pose_points, pose_skeleton
from pipeline.geometry.rotation import axis_angle_to_matrix
from tests.body.acting import simulate_detections, synthetic_recording


@cache
def rest_landmarks_m() -> torch.Tensor:
    body = load_anny()
    model = linearise_body(body, body.shape_defaults)
    return landmark_regressor(model).points(model, torch.zeros(LANDMARK_OFFSET_COUNT, dtype=torch.float64)).rest_m[0]


def test_torso_rotation_is_recovered() -> None:
    rest = rest_landmarks_m()
    turn = axis_angle_to_matrix(torch.tensor([[0.1, 2.5, -0.2], [0.0, -1.0, 0.0]], dtype=torch.float64))
    assert torch.allclose(torso_rotations(rest, rest @ turn.transpose(1, 2) * 0.8), turn, atol=1e-9)


def test_yaw_is_zero_towards_z_and_positive_towards_x() -> None:
    turn = axis_angle_to_matrix(torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.5, 0.0]], dtype=torch.float64))
    assert torch.allclose(facing_yaw_rad(turn), torch.tensor([0.0, 0.5], dtype=torch.float64))
    assert (turn[1] @ torch.tensor([0.0, 0.0, 1.0]).double())[0] > 0


def test_root_position_is_exact_without_noise() -> None:
    scene = synthetic_recording(load_anny(), 5)
    model, state = scene.model, scene.state
    regressor = landmark_regressor(model)
    points = regressor.points(model, state.landmark_offsets_m)
    world = pose_points(model, pose_skeleton(model, state.rotations, state.root_m), points).world_m
    found = solve_root_position(scene.observations(scene.camera), world - state.root_m[:, None])
    assert torch.allclose(found, state.root_m, atol=1e-3)


def test_initial_state_is_near_the_truth_and_gaps_are_interpolated() -> None:
    scene = synthetic_recording(load_anny(), 24)
    scene.landmarks_px[5:8] = np.nan
    observations = scene.observations(scene.camera)
    assert not has_torso_landmarks(observations)[5:8].any()
    start = initial_state(
        observations, rest_landmarks_m(), scene.model.joints_m, scene.state.shape, LANDMARK_OFFSET_COUNT
    )
    assert (start.root_m - scene.state.root_m).norm(dim=-1).max() < 0.2
    difference = start.rotations[:, 0].transpose(1, 2) @ scene.state.rotations[:, 0]
    angle = torch.arccos(((torch.einsum("nii->n", difference) - 1) / 2).clamp(-1, 1))
    assert angle.max() < 0.3


def test_interpolation_keeps_key_frames_and_extrapolates_constantly() -> None:
    scene = synthetic_recording(load_anny(), 9)
    rows = np.array([1, 4, 7])
    filled = interpolated_state(scene.state.select(rows), rows, torch.tensor(scene.time_s))
    assert torch.allclose(filled.rotations[rows], scene.state.rotations[rows], atol=1e-6)
    assert torch.allclose(filled.root_m[0], filled.root_m[1])
    halfway = 0.5 * (scene.state.root_m[1] + scene.state.root_m[4])
    assert torch.allclose(0.5 * (filled.root_m[2] + filled.root_m[3]), halfway)


def test_who_crosses_the_picture_does_not_turn() -> None:
    """Seen 19 degrees to either side of the optical axis, by a detector that knows a crop alone."""
    scene = synthetic_recording(load_anny(), 6, turn_rad=0.0)
    root_m = scene.state.root_m.clone()
    root_m[:, 0] = torch.linspace(-1.0, 1.0, 6)
    recording = simulate_detections(
        load_anny(), scene.model, replace(scene.state, root_m=root_m), scene.camera, scene.time_s
    )
    start = initial_state(
        recording.observations(scene.camera),
        rest_landmarks_m(),
        scene.model.joints_m,
        scene.state.shape,
        LANDMARK_OFFSET_COUNT,
    )
    assert torch.allclose(
        facing_yaw_rad(start.rotations[:, 0]), facing_yaw_rad(scene.state.rotations[:, 0]), atol=np.radians(2.0)
    )
