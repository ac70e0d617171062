import torch

from pipeline.body.fit.root_placement import perspective_to_world, root_jacobian, world_to_perspective
from pipeline.geometry.camera import Camera
from pipeline.geometry.rotation import axis_angle_to_matrix


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
