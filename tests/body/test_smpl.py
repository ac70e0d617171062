"""SMPL-like models: bind pose, shape, landmarks, conversion of poses, and the fit of a known person."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.body.body import Motion, ParametricBody, canonical_to_world, load_anny
from pipeline.body.fit.fit import fit_body
from pipeline.body.fit.landmark_regressor import LANDMARKS
from pipeline.body.fit.linear_body import ACTIVE_JOINTS, RELAXED_CURL_RAD, finger_curl_rotations, relaxed_curls_rad
from pipeline.body.fit.options import FitOptions
from pipeline.body.fit.prior.priors import shape_prior
from pipeline.body.fit.result import FitResult
from pipeline.body.smpl import ARM_DIRECTIONS, FINGER_BEND_RAD, JOINT_NAMES, SmplBody
from pipeline.geometry.rotation import (
    axis_angle_to_matrix,
    matrix_to_quaternion,
    quaternion_to_axis_angle,
)
from pipeline.geometry.skinning import forward_kinematics, linear_blend_skinning, skinning_transforms
from tests.body.acting import SyntheticRecording, fitted_joints_m, joint_errors_m, synthetic_recording
from tests.body.smpl_sample import sample_arrays, smpl_vertices

FRAMES = 16
BETAS = {"beta_0": 1.0, "beta_1": 1.5, "beta_4": -1.0}


@pytest.fixture(scope="module", params=sorted(JOINT_NAMES))
def model(request: pytest.FixtureRequest) -> SmplBody:
    return SmplBody(sample_arrays(request.param))


@pytest.fixture(scope="module")
def smpl() -> SmplBody:
    return SmplBody(sample_arrays(24))


def test_joint_names_are_those_of_the_built_in_body_and_face(model: SmplBody) -> None:
    anny = load_anny()
    assert isinstance(model, ParametricBody)
    assert set(ACTIVE_JOINTS) <= set(model.joint_names)
    assert set(model.joint_names) - set(anny.joint_names) <= {"Jaw", "LeftEye", "RightEye"}
    for name, parent in zip(model.joint_names[1:], model.parents[1:], strict=True):
        above = model.joint_names[parent]
        if name in anny.joint_names:
            assert above == anny.joint_names[anny.parents[anny.joint_names.index(name)]]


def test_arm_directions_equal_those_of_the_built_in_body() -> None:
    """The sample model is the built-in body in a T-pose, so its A-pose must have the joints of that body."""
    anny, model = load_anny(), SmplBody(sample_arrays(24))
    expected = anny.at_shape(anny.shape_defaults)
    found = model.at_shape(model.shape_defaults)
    for name in ACTIVE_JOINTS:
        np.testing.assert_allclose(
            found.joints_m[found.joint(name)], expected.joints_m[expected.joint(name)], atol=0.005, err_msg=name
        )
    assert abs(found.vertices[:, 1].min()) < 1e-5
    for name, direction in ARM_DIRECTIONS.items():
        child = {"Arm": "ForeArm", "ForeArm": "Hand"}[name]
        bone = found.joints_m[found.joint(f"Right{child}")] - found.joints_m[found.joint(f"Right{name}")]
        assert bone / np.linalg.norm(bone) @ (np.array(direction) * [-1, 1, 1]) > 0.999


def test_landmark_positions_equal_those_of_the_built_in_body(model: SmplBody) -> None:
    expected = load_anny().landmark_positions_m
    assert set(model.landmark_positions_m) == {landmark.name for landmark in LANDMARKS}
    for name, place in expected.items():
        assert np.linalg.norm(np.subtract(model.landmark_positions_m[name], place)) < 0.02, name


def test_shape_is_linear_in_the_t_pose_and_differentiable(smpl: SmplBody) -> None:
    arrays = sample_arrays(24)
    betas = torch.linspace(-1.0, 1.0, 10).requires_grad_()
    vertices, joints = smpl.rest_pose(betas)
    t_pose = arrays.template_m + arrays.shape_directions_m @ betas.detach().numpy()
    head = np.flatnonzero(arrays.skin_weights[:, smpl.joint_names.index("Head")] > 0.999)
    moved = vertices[head].detach().numpy() - t_pose[head]  # above the neck the A-pose is the translated T-pose
    np.testing.assert_allclose(moved, np.broadcast_to(moved[0], moved.shape), atol=1e-5)
    pelvis = arrays.joint_regressor[0] @ t_pose
    np.testing.assert_allclose(joints[0, 1].detach().numpy() - pelvis[1], moved[0, 1], atol=1e-5)
    vertices[:, 1].max().backward()
    assert betas.grad is not None
    assert betas.grad[0] > 0.02  # the first beta of the sample enlarges


def test_fingers_bend_towards_the_palm() -> None:
    """In SMPL's T-pose the palms face down; the tip of a bent finger is lower along the normal of the palm."""
    body = SmplBody(sample_arrays(55))
    finger_rotations = quaternion_to_axis_angle(matrix_to_quaternion(finger_curl_rotations(body, relaxed_curls_rad())))
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        index = body.joint_names.index(f"{side}HandMiddle2")
        hand = body.from_smpl_rotations(torch.eye(3).repeat(1, 55, 1, 1))[0, 0]
        assert torch.allclose(hand, torch.eye(3))
        assert float(finger_rotations[index].norm()) == pytest.approx(RELAXED_CURL_RAD, abs=1e-6)
        bind = _bind_rotations(body)[body.joint_names.index(f"{side}Hand")].double()
        closing = bind @ torch.tensor([0.0, 0.0, -sign], dtype=torch.float64)  # flexion axis of a straight finger
        assert finger_rotations[index] @ closing > 0.7 * RELAXED_CURL_RAD
    assert FINGER_BEND_RAD > 0


def test_a_body_without_fingers_has_no_finger_rotations(smpl: SmplBody) -> None:
    assert torch.equal(finger_curl_rotations(smpl, relaxed_curls_rad()), torch.eye(3).double().repeat(24, 1, 1))


def _bind_rotations(body: SmplBody) -> torch.Tensor:
    """Return the world rotations of SMPL's joints in the A-pose, the inverse of those of the T-pose."""
    t_pose = body.from_smpl_rotations(torch.eye(3).repeat(1, len(body.parents), 1, 1))
    world = forward_kinematics(t_pose, torch.zeros(1, 3), torch.zeros(len(body.parents), 3), body.parents)
    return world[0, :, :3, :3].transpose(-1, -2)


def test_smpl_rotations_give_the_same_pose(smpl: SmplBody) -> None:
    """SMPL's skinning from the T-pose and ours from the A-pose agree where the surface follows one joint."""
    arrays = sample_arrays(24)
    generator = torch.Generator().manual_seed(0)
    theta = axis_angle_to_matrix(0.4 * torch.randn(1, 24, 3, generator=generator))
    t_vertices = torch.tensor(arrays.template_m).float()
    t_joints = torch.tensor(arrays.joint_regressor @ arrays.template_m).float()
    expected_pose = forward_kinematics(theta, t_joints[None, 0], t_joints, smpl.parents)
    weights = torch.from_numpy(smpl.skin_weights)
    expected = linear_blend_skinning(t_vertices, weights, skinning_transforms(expected_pose, t_joints))
    vertices, joints = smpl.rest_pose(smpl.shape_defaults)
    pose = forward_kinematics(smpl.from_smpl_rotations(theta), t_joints[None, 0], joints, smpl.parents)
    found = linear_blend_skinning(vertices, weights, skinning_transforms(pose, joints))
    assert torch.allclose(pose[..., :3, 3], expected_pose[..., :3, 3], atol=1e-5)
    rigid = weights.max(dim=1).values > 0.999
    assert rigid.sum() > 300
    assert torch.allclose(found[0, rigid], expected[0, rigid], atol=1e-4)


@pytest.mark.parametrize("count", [24, 52])
def test_converted_smpl_poses_match_smpl(count: int) -> None:
    """Every joint is where SMPL's formula has it, with shape, translation and a rotated world."""
    arrays, body = sample_arrays(count), SmplBody(sample_arrays(count))
    random = np.random.default_rng(0)
    pose, transl, betas = (random.normal(0.0, 0.4, (3, *shape)).astype(np.float32) for shape in ((24, 3), (3,), (10,)))
    pose[:, 22:] = 0.0
    to_world = np.tile(np.eye(4, dtype=np.float32), (3, 1, 1))
    to_world[:, :3, :3] = axis_angle_to_matrix(torch.tensor([3.0, 0.2, -0.1])).numpy()
    to_world[:, :3, 3] = [0.1, -0.2, 4.0]
    rotations, root_m = body.convert_smpl_poses(*map(torch.from_numpy, (pose, transl, betas, to_world)))
    assert rotations.shape[1] == (24 if count == 24 else 22)
    for frame in range(3):
        theta = np.zeros((count, 3))
        theta[:22] = pose[frame, :22]
        _, expected = smpl_vertices(arrays, betas[frame], theta, transl[frame])
        expected = expected @ to_world[frame, :3, :3].T + to_world[frame, :3, 3]
        joints_m = body.rest_pose(torch.from_numpy(betas[frame]))[1]
        local = torch.eye(3).repeat(1, count, 1, 1)
        local[0, : rotations.shape[1]] = rotations[frame]
        found = forward_kinematics(local, root_m[frame : frame + 1], joints_m, body.parents)[0, :22, :3, 3]
        np.testing.assert_allclose(found, expected[:22], atol=1e-4)


def test_converted_poses_of_the_real_data_set_match_smpl(shared_data: Path, smpl: SmplBody) -> None:
    """InstantAvatar's file: the surface matches where it follows one joint."""
    with np.load(shared_data / "formats" / "male-3-casual_test.npz") as file:
        pose = np.concatenate([file["global_orient"], file["body_pose"]], axis=1)[::20].reshape(-1, 24, 3)
        transl, betas = file["transl"][::20], np.repeat(file["betas"], len(pose), axis=0)
    identity = torch.eye(4).repeat(len(pose), 1, 1)
    rotations, root_m = smpl.convert_smpl_poses(*map(torch.from_numpy, (pose, transl, betas)), identity)
    body = smpl.at_shape(torch.from_numpy(betas[0]))
    quaternions = matrix_to_quaternion(rotations).numpy()
    motion = Motion(np.arange(len(pose), dtype=np.int32), np.arange(len(pose)) / 25.0, quaternions, root_m.numpy())
    weights = torch.from_numpy(body.skin_weights)
    found = linear_blend_skinning(torch.from_numpy(body.vertices), weights, canonical_to_world(body, motion))
    rigid = (weights.max(dim=1).values > 0.999).numpy()
    for frame in range(len(pose)):
        expected, _ = smpl_vertices(sample_arrays(24), betas[0], pose[frame], transl[frame])
        np.testing.assert_allclose(found[frame, rigid], expected[rigid], atol=5e-4)


def test_smpl_poses_are_accepted_by_models_with_the_same_shapes() -> None:
    assert [SmplBody(sample_arrays(count)).accepts_smpl_poses(10) for count in (24, 52, 55)] == [True, True, False]
    assert not SmplBody(sample_arrays(24)).accepts_smpl_poses(16)


def test_betas_have_a_unit_prior(smpl: SmplBody) -> None:
    prior = shape_prior(smpl.shape_names, smpl.shape_defaults)
    assert prior.std.tolist() == [1.0] * 10
    assert prior.lower_bound.tolist() == [-5.0] * 10
    assert prior.upper_bound.tolist() == [5.0] * 10


def test_a_model_with_other_joints_is_refused() -> None:
    arrays = sample_arrays(24)
    with pytest.raises(ValueError, match="23 joints"):
        SmplBody(
            replace(
                arrays,
                parents=arrays.parents[:23],
                joint_regressor=arrays.joint_regressor[:23],
                skin_weights=arrays.skin_weights[:, :23],
            )
        )


@pytest.fixture(scope="module")
def fitted(smpl: SmplBody) -> tuple[SyntheticRecording, FitResult]:
    scene = synthetic_recording(smpl, FRAMES, shape=BETAS, noise_m=0.005)
    options = FitOptions(scene.model.height_m()[0], focal_relative_std=0.0, shared_frames=FRAMES, rounds=4)
    return scene, fit_body(smpl, scene.observations(scene.camera), scene.windows(), options)


@pytest.mark.slow
def test_a_known_pose_is_fitted(fitted: tuple[SyntheticRecording, FitResult]) -> None:
    scene, result = fitted
    found = fitted_joints_m(result, scene)
    aligned, absolute = joint_errors_m(found, scene.joints_m())
    assert aligned < 0.015
    assert absolute < 0.030
    assert np.median(result.silhouette_iou) > 0.95


def test_a_known_shape_is_fitted(fitted: tuple[SyntheticRecording, FitResult], smpl: SmplBody) -> None:
    """The surface is within 1 cm, and closer than the mean body scaled to the true stature."""
    scene, result = fitted
    true = scene.model.vertices_m.numpy()
    mean = smpl.at_shape(smpl.shape_defaults).vertices
    mean = mean * (np.ptp(true[:, 1]) / np.ptp(mean[:, 1]))
    error = np.linalg.norm(result.body.vertices - true, axis=1).mean()
    assert error < 0.010
    assert error < 0.5 * np.linalg.norm(mean - true, axis=1).mean()
