"""The axis of a turn from pixels: recovered for tilted cameras, absent without a turn or a rigid body."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipeline.body.body import load_anny
from pipeline.body.fit.state import Observations
from pipeline.body.fit.vertical.turn_axis import (
    AXIS_LANDMARKS,
    _Problem,
    axis_rotation,
    contradicting_focal_log,
    estimate_turn_axis,
    yaw_resultant,
)
from pipeline.geometry.camera import Camera
from tests.body.acting import synthetic_recording

POINTS = 41


def turning_body(tilt: tuple[float, float], turn_rad: float = 2 * np.pi, swing_m: float = 0.0) -> Observations:
    """Return exact pixels of a rigid body that turns about (right, 1, towards) 3 m away; flattened 3D landmarks."""
    random = np.random.default_rng(4)
    body = random.uniform([0.02, -0.8, -0.15], [0.5, 0.8, 0.15], (POINTS, 3))
    for left, right in ((7, 8), *((index, index + 1) for index in (11, 13, 15, 23, 25, 27, 29, 31))):
        body[right] = body[left] * [-1.0, 1.0, 1.0]
    yaw = np.linspace(0.0, turn_rad, 30, endpoint=False)
    sine, cosine = np.sin(yaw)[:, None], np.cos(yaw)[:, None]
    moved = body + swing_m * np.sin(5.0 * yaw)[:, None, None] * random.normal(size=(POINTS, 3))
    x, y, z = np.moveaxis(moved, -1, 0)
    turned = np.stack([cosine * x + sine * z, y, cosine * z - sine * x], axis=-1)
    seen = turned @ axis_rotation(*tilt).T + [0.05, -0.1, -3.0]
    camera = Camera(500.0, 500.0, 160.0, 120.0, 320, 240)
    pixels = np.stack([160.0 + 500.0 * seen[..., 0] / -seen[..., 2], 120.0 - 500.0 * seen[..., 1] / -seen[..., 2]], -1)
    ones = torch.ones(len(yaw), POINTS, dtype=torch.float64)
    level = turned - turned[:, [23, 24]].mean(1, keepdims=True)
    return Observations(
        torch.arange(len(yaw), dtype=torch.float64) / 10, torch.tensor(pixels), torch.tensor(level), ones, ones, camera
    )


def test_axis_rotation_takes_y_to_the_axis() -> None:
    rotation = axis_rotation(-0.1, 0.3)
    assert np.allclose(rotation @ rotation.T, np.eye(3))
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    assert np.allclose(rotation[:, 1] * np.sqrt(1.0 + 0.01 + 0.09), [-0.1, 1.0, 0.3])
    assert rotation[2, 0] == 0.0


def test_jacobian_is_the_derivative_of_the_residuals() -> None:
    random, frames, points = np.random.default_rng(1), 7, len(AXIS_LANDMARKS)
    rays, weight = random.normal(scale=0.1, size=(frames, points, 2)), random.random((frames, points, 1))
    body, yaw = random.normal(scale=0.2, size=(points, 3)), np.linspace(0.0, 6.0, frames)
    problem = _Problem(rays, weight, body, yaw, height=0.7, focal_log_std=0.3)
    at = problem.start() + random.normal(scale=0.05, size=len(problem.start()))
    steps = 1e-6 * np.eye(len(at))
    differences = [(problem.residuals(at + step) - problem.residuals(at - step)) / 2e-6 for step in steps]
    np.testing.assert_allclose(problem.jacobian(at), np.stack(differences, axis=1), atol=1e-5)


@pytest.mark.parametrize("tilt", [(0.0, 0.0), (-0.09, 0.27), (0.05, -0.18)])
def test_axis_of_exact_pixels_is_recovered(tilt: tuple[float, float]) -> None:
    """The 3D landmarks say that the camera is level, the pixels do not."""
    axis = estimate_turn_axis(turning_body(tilt), 0.0)
    assert axis is not None
    assert axis.tilt_rad == pytest.approx(tilt, abs=0.005)
    assert axis.std_rad.max() < 0.05


def test_focal_length_is_recovered_with_the_axis() -> None:
    observations = turning_body((0.0, 0.2))
    camera = replace(observations.camera, fx=600.0, fy=600.0)
    axis = estimate_turn_axis(replace(observations, camera=camera), 0.5)
    assert axis is not None
    assert axis.tilt_rad == pytest.approx((0.0, 0.2), abs=0.005)
    assert 600.0 * np.exp(axis.focal_log) == pytest.approx(500.0, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize(("ratio", "contradicts"), [(0.5, True), (1.05, False), (2.0, True)])
def test_a_supplied_focal_length_that_contradicts_the_turn_is_found(ratio: float, contradicts: bool) -> None:
    observations = turning_body((0.0, 0.1))
    camera = replace(observations.camera, fx=500.0 * ratio, fy=500.0 * ratio)
    found = contradicting_focal_log(replace(observations, camera=camera))
    assert found == pytest.approx(-np.log(ratio) if contradicts else 0.0, abs=0.1)


def test_without_a_turn_nothing_contradicts_a_focal_length() -> None:
    observations = turning_body((0.0, 0.2), turn_rad=2.5)
    camera = replace(observations.camera, fx=1000.0, fy=1000.0)
    assert contradicting_focal_log(replace(observations, camera=camera)) == 0.0


@pytest.mark.parametrize("arc_deg", [50.0, 140.0])
@pytest.mark.parametrize("tilt", [(-0.09, 0.27), (0.05, -0.18)])
def test_an_arc_shows_the_axis(tilt: tuple[float, float], arc_deg: float) -> None:
    axis = estimate_turn_axis(turning_body(tilt, np.radians(arc_deg)), 0.5)
    assert axis is not None
    assert axis.tilt_rad == pytest.approx(tilt, abs=0.01)


def test_an_arc_is_less_certain_than_a_turn() -> None:
    turn, arc = (estimate_turn_axis(turning_body((0.0, 0.2), turn_rad), 0.5) for turn_rad in (2 * np.pi, 1.5))
    assert turn is not None
    assert arc is not None
    assert (arc.std_rad > turn.std_rad).all()


def test_a_person_who_hardly_turns_gives_no_axis() -> None:
    assert estimate_turn_axis(turning_body((0.0, 0.2), turn_rad=np.radians(35.0)), 0.5) is None


def test_an_arc_of_a_body_that_is_not_rigid_gives_no_axis() -> None:
    """It swings as much as a turn tolerates, and as a person who walks in an arc."""
    assert estimate_turn_axis(turning_body((0.0, 0.2), turn_rad=2.5, swing_m=0.04), 0.5) is None


@pytest.mark.slow
def test_a_body_that_is_not_rigid_gives_no_axis() -> None:
    assert estimate_turn_axis(turning_body((0.0, 0.2), swing_m=0.4), 0.5) is None


def test_a_camera_that_drifts_gives_no_axis() -> None:
    """Up and down by a tenth of the picture looks like a lens of eight times the focal length."""
    observations = turning_body((0.0, 0.05))
    frame = torch.arange(len(observations.time_s), dtype=torch.float64)
    drift_px = 24.0 * torch.stack([torch.sin(0.9 * frame), torch.cos(1.3 * frame)], dim=-1)
    drifting = replace(observations, landmarks_px=observations.landmarks_px + drift_px[:, None])
    assert estimate_turn_axis(drifting, 0.5) is None


def test_undetected_feet_give_no_axis() -> None:
    observations = turning_body((0.0, 0.2))
    confidence = observations.confidence.clone()
    confidence[:, 29:33] = 0.0
    assert estimate_turn_axis(replace(observations, confidence=confidence), 0.5) is None


@pytest.mark.slow
def test_a_level_turn_with_swinging_limbs_stays_level() -> None:
    scene = synthetic_recording(load_anny(), frames=30)
    axis = estimate_turn_axis(scene.observations(scene.camera), 0.5)
    assert axis is not None
    assert np.abs(axis.tilt_rad).max() < 2.5 * axis.std_rad.max()
    assert np.abs(axis.tilt_rad).max() < np.radians(3.0)


def test_resultant_of_arcs() -> None:
    """The mean of unit vectors over an arc a is sin(a / 2) / (a / 2)."""
    assert yaw_resultant(np.linspace(0.0, 2 * np.pi, 60, endpoint=False)) == pytest.approx(0.0, abs=1e-12)
    assert yaw_resultant(np.linspace(0.0, np.pi, 2000)) == pytest.approx(2.0 / np.pi, abs=1e-3)
    assert yaw_resultant(np.full(5, 1.3)) == pytest.approx(1.0)
