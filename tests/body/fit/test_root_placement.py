import torch

from pipeline.body.fit.root_placement import (
    line_of_sight_rotation,
    perspective_to_world,
    root_jacobian,
    world_to_perspective,
)
from pipeline.geometry.camera import Camera
from pipeline.geometry.rotation import axis_angle_to_matrix, rotation_between


def tilted_camera() -> Camera:
    pose = torch.eye(4)
    pose[:3, :3] = axis_angle_to_matrix(torch.tensor([2.9, 0.2, -0.1]))
    pose[:3, 3] = torch.tensor([0.1, -0.3, 4.0])
    return Camera(500.0, 510.0, 100.0, 120.0, 200, 240, pose.numpy())


ROOTS = torch.tensor([[0.1, 0.2, 0.3], [-0.5, 1.0, -0.4]], dtype=torch.float64)


def test_perspective_coordinates_are_invertible() -> None:
    camera = tilted_camera()
    assert torch.allclose(perspective_to_world(world_to_perspective(ROOTS, camera), camera), ROOTS, atol=1e-5)


def test_derivative_agrees_with_differences() -> None:
    camera = tilted_camera()
    root_perspective = world_to_perspective(ROOTS, camera)
    for axis in range(3):
        step = torch.zeros(3, dtype=torch.float64)
        step[axis] = 1e-6
        moved = (
            perspective_to_world(root_perspective + step, camera)
            - perspective_to_world(root_perspective - step, camera)
        ) / 2e-6
        assert torch.allclose(root_jacobian(ROOTS, camera)[..., axis], moved, atol=1e-5)


def test_scaling_the_world_changes_log_depth_only() -> None:
    camera = Camera(500.0, 500.0, 100.0, 100.0, 200, 200)
    roots = torch.tensor([[0.1, 0.2, -3.0], [0.3, -0.1, -2.5]], dtype=torch.float64)
    near, far = world_to_perspective(roots, camera), world_to_perspective(1.3 * roots, camera)
    assert torch.allclose(near[:, :2], far[:, :2])
    assert torch.allclose(far[:, 2] - near[:, 2], torch.full((2,), 1.3, dtype=torch.float64).log())


DIRECTIONS = torch.tensor([[0.0, 0.0], [0.4, -0.2], [-1.5, 0.7]], dtype=torch.float64)


def test_lines_of_sight_become_the_optical_axis_by_the_smallest_rotation() -> None:
    lines = torch.nn.functional.normalize(torch.nn.functional.pad(DIRECTIONS, (0, 1), value=1.0), dim=1)
    axis = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand_as(lines)
    assert torch.allclose(line_of_sight_rotation(DIRECTIONS)[0], rotation_between(lines, axis))


def test_derivative_of_the_line_of_sight_agrees_with_differences() -> None:
    _, jacobian = line_of_sight_rotation(DIRECTIONS)
    for axis, step in enumerate(1e-6 * torch.eye(2, dtype=torch.float64)):
        ahead, behind = (line_of_sight_rotation(DIRECTIONS + sign * step)[0] for sign in (1.0, -1.0))
        assert torch.allclose(jacobian[:, axis], (ahead - behind) / 2e-6, atol=1e-8)
