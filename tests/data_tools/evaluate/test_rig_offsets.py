"""Rotations between two rigs, against rigs that differ by known rotations."""

import numpy as np
import pytest
import torch

from data_tools.evaluate.rig_offsets import joint_rotations_in_camera, mean_rotation_offsets, rotate_joints
from pipeline.body.body import Body, Motion
from pipeline.geometry.camera import Camera
from pipeline.geometry.rotation import axis_angle_to_matrix, axis_angle_to_quaternion


@pytest.fixture
def body() -> Body:
    return Body(
        joint_names=("root", "knee", "foot"),
        parents=np.array([-1, 0, 1], dtype=np.int32),
        joints_m=np.array([[0.0, 1.0, 0.0], [0.0, 0.5, 0.0], [0.1, 0.0, 0.0]], dtype=np.float32),
        vertices=np.zeros((3, 3), dtype=np.float32),
        faces=np.array([[0, 1, 2]], dtype=np.int32),
        skin_weights=np.eye(3, dtype=np.float32),
        shape={},
    )


def random_motion(count: int, seed: int, angle_rad: float = 1.0) -> Motion:
    vectors = angle_rad * torch.randn(count, 3, 3, generator=torch.Generator().manual_seed(seed))
    return Motion(
        np.arange(count, dtype=np.int32),
        np.arange(count) / 30.0,
        axis_angle_to_quaternion(vectors).numpy().astype(np.float32),
        np.zeros((count, 3), dtype=np.float32),
    )


def camera(world_to_camera: np.ndarray) -> Camera:
    return Camera(500.0, 500.0, 50.0, 50.0, 100, 100, world_to_camera.astype(np.float32))


def test_constant_offsets_are_found_and_applied(body: Body) -> None:
    reference = random_motion(20, seed=0)
    offsets = axis_angle_to_matrix(0.3 * torch.randn(3, 3, generator=torch.Generator().manual_seed(5)).double())
    moved = rotate_joints(body, reference, offsets)
    level = camera(np.eye(4))
    found = mean_rotation_offsets(
        joint_rotations_in_camera(body, moved, level), joint_rotations_in_camera(body, reference, level)
    )
    torch.testing.assert_close(found, offsets, atol=1e-5, rtol=0.0)


def test_rotations_are_in_camera_axes(body: Body) -> None:
    motion = random_motion(5, seed=1)
    turn = axis_angle_to_matrix(torch.tensor([0.2, -0.4, 0.1]).double())
    turned_camera = np.eye(4)
    turned_camera[:3, :3] = turn.numpy()
    expected = turn @ joint_rotations_in_camera(body, motion, camera(np.eye(4)))
    torch.testing.assert_close(
        joint_rotations_in_camera(body, motion, camera(turned_camera)), expected, atol=1e-6, rtol=0.0
    )


def test_noise_averages_out(body: Body) -> None:
    reference, level = random_motion(400, seed=2), camera(np.eye(4))
    rotations = joint_rotations_in_camera(body, reference, level)
    noise = axis_angle_to_matrix(0.1 * torch.randn(400, 3, 3, generator=torch.Generator().manual_seed(3)).double())
    found = mean_rotation_offsets(rotations @ noise, rotations)
    torch.testing.assert_close(found, torch.eye(3).double().repeat(3, 1, 1), atol=0.02, rtol=0.0)
