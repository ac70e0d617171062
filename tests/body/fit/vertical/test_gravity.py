"""The vertical: recovered from people who stand or turn in a tilted world; level without evidence."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipeline.body.body import load_anny
from pipeline.body.fit import fit as fit_module
from pipeline.body.fit.ground_contact import FLOOR_TILT_STD_RAD, floor_tilt_information, sole_points
from pipeline.body.fit.initialisation import in_world_axes
from pipeline.body.fit.landmark_regressor import landmark_regressor
from pipeline.body.fit.linear_body import ACTIVE_JOINTS
from pipeline.body.fit.options import FitOptions
from pipeline.body.fit.posed_points import pose_points, pose_skeleton
from pipeline.body.fit.state import FitState, Observations
from pipeline.body.fit.vertical.gravity import (
    LEAN_GAIN_TOWARDS,
    LEAN_OF_ELEVATION,
    MAX_TURN_RAD,
    USUAL_ELEVATION_RAD,
    TiltEvidence,
    align_with_gravity,
    axis_evidence,
    camera_tilt_deg,
    level_evidence,
    mean_lean_rad,
    turn_camera,
    turn_observations,
    turn_state,
    upright_turn,
)
from pipeline.body.fit.vertical.turn_axis import TurnAxis, estimate_turn_axis
from pipeline.body.settings import FitSettings
from pipeline.geometry.camera import Camera, project
from pipeline.geometry.rotation import axis_angle_to_matrix
from tests.body.acting import SyntheticRecording, simulate_detections, synthetic_recording

FRAMES = 24
SETTINGS = FitSettings()
STILL = torch.zeros(3, dtype=torch.float64)


def rotation_deg(x: float, y: float, z: float) -> torch.Tensor:
    return axis_angle_to_matrix(torch.tensor(np.radians([x, y, z])))


def standing(turn_rad: float) -> SyntheticRecording:
    """Return a person in the A-pose on a level floor who turns on the spot."""
    scene = synthetic_recording(load_anny(), FRAMES)
    rotations = torch.eye(3, dtype=torch.float64).repeat(FRAMES, scene.state.rotations.shape[1], 1, 1)
    yaw = torch.zeros(FRAMES, 3, dtype=torch.float64)
    yaw[:, 1] = torch.arange(FRAMES) * turn_rad / FRAMES
    rotations[:, 0] = axis_angle_to_matrix(yaw)
    root_m = scene.state.root_m[:1].repeat(FRAMES, 1)
    state = replace(scene.state, rotations=rotations, root_m=root_m)
    return simulate_detections(load_anny(), scene.model, state, scene.camera, scene.time_s)


def heights_m(scene: SyntheticRecording, rotations: torch.Tensor, root_m: torch.Tensor) -> torch.Tensor:
    skeleton = pose_skeleton(scene.model, rotations, root_m)
    return pose_points(scene.model, skeleton, sole_points(scene.model)).world_m[..., 1]


def test_turning_the_world_keeps_the_image() -> None:
    scene = synthetic_recording(load_anny(), FRAMES)
    rotation, translation_m = rotation_deg(12.0, -7.0, 4.0), torch.tensor([0.3, -0.9, 1.0], dtype=torch.float64)
    before, depth_m = project(scene.joints_m(), scene.camera)
    turned = turn_state(scene.state, rotation, translation_m)
    skeleton = pose_skeleton(scene.model, turned.rotations, turned.root_m)
    after, turned_depth_m = project(skeleton.position_m, turn_camera(scene.camera, rotation, translation_m))
    assert torch.allclose(before, after, atol=1e-3)
    assert torch.allclose(depth_m, turned_depth_m, atol=1e-5)


@pytest.mark.parametrize(("pitch_deg", "roll_deg"), [(0.0, 0.0), (-15.0, 5.0), (10.0, -3.0)])
def test_tilt_of_a_camera(pitch_deg: float, roll_deg: float) -> None:
    """A camera that is rolled about its axis and then pitched about the world's x axis."""
    level = Camera(500.0, 500.0, 160.0, 120.0, 320, 240)
    turn = rotation_deg(pitch_deg, 0.0, 0.0) @ rotation_deg(0.0, 0.0, -roll_deg)
    matrix = np.eye(4, dtype=np.float32)
    matrix[:3, :3] = level.world_to_camera[:3, :3] @ turn.numpy().T
    assert camera_tilt_deg(replace(level, world_to_camera=matrix)) == pytest.approx((pitch_deg, roll_deg), abs=1e-4)


def test_shared_tilt_is_separated_from_the_lean_of_the_body() -> None:
    """A body that leans by 0.1 forward in its own frame turns in a world whose vertical has the slope (0.05, -0.2)."""
    yaw = torch.linspace(0.0, 2 * np.pi, 41, dtype=torch.float64)[:-1]
    lean = 0.1 * torch.stack([yaw.sin(), yaw.cos()], dim=1)
    slope = lean + torch.tensor([0.05, -0.2], dtype=torch.float64)
    axes = torch.stack([slope[:, 0], torch.ones_like(yaw), slope[:, 1]], dim=1)
    assert mean_lean_rad(axes, yaw).tolist() == pytest.approx([0.05, -0.2], abs=1e-9)
    part = yaw < np.pi * 4 / 3
    assert mean_lean_rad(axes[part], yaw[part]).tolist() == pytest.approx([0.05, -0.2], abs=0.01)


def test_evidence_is_weighted_by_its_precision() -> None:
    std = torch.tensor([0.1, 0.1], dtype=torch.float64)
    first = TiltEvidence.from_std(torch.tensor([0.2, 0.0], dtype=torch.float64), std)
    second = TiltEvidence.from_std(torch.tensor([0.0, 0.1], dtype=torch.float64), 0.5 * std)
    up = (first + second).up()
    assert (up[[0, 2]] / up[1]).tolist() == pytest.approx([0.2 / 5.0, 0.4 / 5.0])


def test_information_of_a_floor_grows_with_its_extent() -> None:
    random = np.random.default_rng(5)
    positions = torch.tensor(random.uniform(-1.0, 1.0, (30, 4, 3)) * [1.0, 0.0, 0.1])
    ones = torch.ones(30, 4, dtype=torch.float64)
    information = floor_tilt_information(positions, ones)
    wide = torch.linalg.eigvalsh(information)
    assert wide[1] < FLOOR_TILT_STD_RAD**-2
    assert wide[1] > 10.0 * wide[0]
    assert torch.linalg.eigvalsh(floor_tilt_information(0.01 * positions, ones)).max() < 1.0


@pytest.mark.parametrize("tilt_deg", [(0.0, 0.0), (8.0, -4.0)])
def test_a_turn_in_a_tilted_world_is_set_upright(tilt_deg: tuple[float, float]) -> None:
    """The person stands upright on y = 0 afterwards, and the camera has the tilt of the world."""
    scene = standing(2 * np.pi)
    tilt = rotation_deg(tilt_deg[0], 0.0, tilt_deg[1])
    state = turn_state(scene.state, tilt, STILL)
    observations = scene.observations(scene.camera)
    state, aligned = align_with_gravity(scene.model, state, observations, level_evidence(SETTINGS), SETTINGS)
    up = state.rotations[:, 0, :, 1].mean(0)
    assert np.degrees(np.arccos(float(up[1] / up.norm()))) < 0.6
    assert heights_m(scene, state.rotations, state.root_m).abs().max() < 0.01
    expected = camera_tilt_deg(turn_camera(scene.camera, tilt.T, STILL))
    assert camera_tilt_deg(aligned.camera) == pytest.approx(expected, abs=0.6)


def test_a_person_who_stands_still_is_no_evidence() -> None:
    """Who leans by 10 degrees to the camera in all frames may do so; the floor moves to y = 0."""
    scene = standing(0.3)
    state = turn_state(scene.state, rotation_deg(10.0, 0.0, 0.0), STILL)
    observations = scene.observations(scene.camera)
    evidence = axis_evidence(estimate_turn_axis(observations, 0.0), SETTINGS)
    assert torch.equal(evidence.up(), torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))
    _, aligned = align_with_gravity(scene.model, state, observations, evidence, SETTINGS)
    assert camera_tilt_deg(aligned.camera) == pytest.approx((0.0, 0.0), abs=1.5)


def test_observations_of_a_turn_become_upright() -> None:
    """The detector reports half of the tilt of 10 degrees; its torso is upright afterwards."""
    scene = standing(2 * np.pi)
    observations = scene.observations(scene.camera)
    half = rotation_deg(5.0, 0.0, 0.0)
    observations = replace(observations, landmarks_3d_m=observations.landmarks_3d_m @ half.T)
    regressor = landmark_regressor(scene.model)
    rest = regressor.points(scene.model, scene.state.landmark_offsets_m).rest_m[0]
    up = rotation_deg(10.0, 0.0, 0.0)[:, 1]
    axis = TurnAxis(np.zeros(2), np.ones(2), focal_log=float(np.log(1.25)), focal_log_std=0.1)
    turned = turn_observations(observations, up, axis, rest)
    upright_m = in_world_axes(turned)
    torso = upright_m[:, 11:13].mean(1) - upright_m[:, 23:25].mean(1)
    lean = torso.mean(0)
    assert np.degrees(np.arctan2(float(lean[2]), float(lean[1]))) == pytest.approx(0.0, abs=3.0)
    assert camera_tilt_deg(turned.camera) == pytest.approx((-10.0, 0.0), abs=1e-4)
    assert turned.camera.fx == pytest.approx(1.25 * scene.camera.fx)
    unturned = turn_observations(observations, up, None, rest)
    assert torch.allclose(unturned.landmarks_3d_m, observations.landmarks_3d_m @ rotation_deg(-10.0, 0.0, 0.0).T)
    assert unturned.camera.fx == scene.camera.fx


def test_the_world_is_turned_by_the_mean_lean_of_a_turn() -> None:
    """Hardly anything is known of the vertical but the bodies, and then the axis of the turn as well."""
    scene = standing(2 * np.pi)

    neck_m = pose_skeleton(scene.model, scene.state.rotations, scene.state.root_m).position_m[
        0, ACTIVE_JOINTS.index("Neck")
    ]

    def camera_below_neck(elevation_deg: float) -> Camera:
        """Return a camera 2 m in front of the neck from which it is seen under this elevation."""
        world_to_camera = np.diag([1.0, -1.0, -1.0, 1.0])
        centre_m = neck_m.numpy() + [0.0, -2.0 * np.tan(np.radians(elevation_deg)), 2.0]
        world_to_camera[:3, 3] = -world_to_camera[:3, :3] @ centre_m
        return replace(scene.camera, world_to_camera=world_to_camera.astype(np.float32))

    from_above = camera_below_neck(-5.0)

    def turn(state: FitState, axis_std_rad: float = np.pi, camera: Camera = from_above) -> torch.Tensor:
        """Return where +Y of the old world points, to the right and towards the camera, degrees."""
        axis = TiltEvidence.from_std(STILL[:2], torch.full_like(STILL[:2], axis_std_rad))
        return torch.rad2deg(upright_turn(scene.model, state, axis, SETTINGS, camera)[[0, 2], 1])

    trunk = turn(scene.state)  # that of the A-pose leans a little in the body's frame
    assert trunk.abs().max() < 0.6
    leaning = turn_state(scene.state, rotation_deg(2.0, 0.0, 0.0) @ rotation_deg(0.0, 0.0, -1.0), STILL)
    assert (turn(leaning) - trunk).tolist() == pytest.approx([-1.0, -2.0 * LEAN_GAIN_TOWARDS], abs=0.1)
    slightly = turn_state(scene.state, rotation_deg(0.2, 0.0, 0.0), STILL)
    halved = turn(slightly, np.radians(SETTINGS.body_axis_std_deg))  # as sure as the bodies are
    assert float(halved[1] / turn(slightly)[1]) == pytest.approx(0.5, abs=0.05)
    fallen = turn(turn_state(scene.state, rotation_deg(20.0, 0.0, 0.0), STILL))
    assert float(fallen[1]) == pytest.approx(-np.degrees(MAX_TURN_RAD), abs=0.1)
    usual_deg = float(np.degrees(USUAL_ELEVATION_RAD))
    for beyond_deg in (-2.0, 0.0, 10.0, 25.0):
        towards_deg = turn(scene.state, camera=camera_below_neck(usual_deg + beyond_deg))[1] - trunk[1]
        expected_deg = LEAN_GAIN_TOWARDS * LEAN_OF_ELEVATION * max(0.0, beyond_deg)
        assert float(towards_deg) == pytest.approx(expected_deg, abs=0.05)
    assert turn(turn_state(standing(0.3).state, rotation_deg(5.0, 0.0, 0.0), STILL)).tolist() == [0.0, 0.0]


def test_evidence_that_contradicts_the_bodies_is_doubted() -> None:
    std = torch.tensor([0.01, 0.02], dtype=torch.float64)
    evidence = TiltEvidence.from_std(torch.tensor([0.03, 0.0], dtype=torch.float64), std)
    agreeing = evidence.doubted(torch.tensor([0.03, 0.0], dtype=torch.float64))
    assert torch.allclose(agreeing.information, evidence.information)
    two_stds = evidence.doubted(torch.tensor([0.03, 0.04], dtype=torch.float64))
    assert torch.allclose(two_stds.information, 0.25 * evidence.information)
    assert torch.allclose(two_stds.up(), evidence.up())


def test_evidence_about_another_vertical() -> None:
    std = torch.tensor([0.1, 0.3], dtype=torch.float64)
    evidence = TiltEvidence.from_std(torch.tensor([0.2, 0.0], dtype=torch.float64), std)
    up = rotation_deg(3.0, 0.0, -2.0)[:, 1]
    assert torch.allclose(evidence.about(up).up(), up)
    assert torch.equal(evidence.about(up).information, evidence.information)


def test_silhouettes_mend_a_wrong_axis(monkeypatch: pytest.MonkeyPatch) -> None:
    """Landmarks said that the level camera looks down by 5 degrees; the outlines of the turn know better."""
    scene = standing(2 * np.pi)
    wrong = TurnAxis(np.radians([0.0, 5.0]), np.radians([2.0, 2.0]), focal_log=0.0, focal_log_std=0.1)
    monkeypatch.setattr(fit_module, "estimate_turn_axis", lambda *_: wrong)
    options = FitOptions(shared_frames=12, rounds=6, vertical_is_known=False)
    result = fit_module.fit_body(load_anny(), scene.observations(scene.camera), scene.windows(), options)
    assert camera_tilt_deg(result.camera) == pytest.approx((0.0, 0.0), abs=1.5)


@pytest.mark.parametrize(("is_arc", "found_std"), [(False, 0.5), (True, 0.1)])
def test_landmarks_of_a_turn_do_not_tell_the_focal_length_twice(
    is_arc: bool, found_std: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The fit starts with the focal length of the axis; only that of an arc, which tells little, is evidence."""
    found: list[tuple[float, float]] = []

    def stop(context: object, observations: Observations, *arguments: object) -> None:
        found.extend((observations.camera.fx, each.focal_relative_std) for each in arguments if hasattr(each, "rounds"))
        raise KeyboardInterrupt

    scene = standing(2 * np.pi)
    axis = TurnAxis(np.zeros(2), np.ones(2), focal_log=float(np.log(1.25)), focal_log_std=0.1, is_arc=is_arc)
    monkeypatch.setattr(fit_module, "estimate_turn_axis", lambda *_: axis)
    monkeypatch.setattr(fit_module, "_fit_shared", stop)
    options = FitOptions(focal_relative_std=0.5, vertical_is_known=False)
    with pytest.raises(KeyboardInterrupt):
        fit_module.fit_body(load_anny(), scene.observations(scene.camera), scene.windows(), options)
    assert found == [(pytest.approx(1.25 * scene.camera.fx), found_std)]
