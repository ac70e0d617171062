"""The camera against OpenCV's projection, and its projection against its rays."""

import cv2
import numpy as np
import pytest
import torch

from pipeline.geometry.camera import Camera, pixel_rays, project, project_to_pixels
from pipeline.geometry.rotation import axis_angle_to_matrix


@pytest.fixture
def camera() -> Camera:
    pose = np.eye(4, dtype=np.float32)
    pose[:3, :3] = axis_angle_to_matrix(torch.tensor([0.2, -0.3, 0.1])).numpy()
    pose[:3, 3] = [0.1, -0.2, 3.0]
    return Camera(700.0, 710.0, 321.0, 235.0, 640, 480, pose)


def test_project_agrees_with_opencv(camera: Camera) -> None:
    points = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32) * 0.5
    rotation_vector, _ = cv2.Rodrigues(camera.world_to_camera[:3, :3].astype(np.float64))
    expected, _ = cv2.projectPoints(
        points.astype(np.float64), rotation_vector, camera.world_to_camera[:3, 3].astype(np.float64),
        np.array([[700.0, 0.0, 321.0], [0.0, 710.0, 235.0], [0.0, 0.0, 1.0]]), None,
    )  # fmt: skip
    pixels_px, depth_m = project(torch.as_tensor(points), camera)
    assert depth_m.min() > 0
    np.testing.assert_allclose(pixels_px.numpy(), expected[:, 0], atol=2e-3)


def test_a_ray_passes_through_every_point_that_projects_to_its_pixel(camera: Camera) -> None:
    points = torch.randn(20, 3, generator=torch.Generator().manual_seed(1)) * 0.5
    pixels_px, _ = project(points, camera)
    origins, directions = pixel_rays(camera, pixels_px)
    along = ((points - origins) * directions).sum(-1, keepdim=True)
    torch.testing.assert_close(origins + along * directions, points, atol=2e-5, rtol=0)
    np.testing.assert_allclose(origins[0].numpy(), camera.centre_m(), atol=1e-6)


def test_points_fall_into_the_pixels_of_their_rays_and_only_those_in_the_image_count(camera: Camera) -> None:
    corners_px = torch.tensor([[0.5, 0.5], [639.5, 0.5], [0.5, 479.5], [639.5, 479.5]])
    outside_px = torch.tensor([[-0.5, 9.5], [640.5, 9.5], [9.5, -0.5], [9.5, 480.5]])
    origins, directions = pixel_rays(camera, torch.cat([corners_px, outside_px]))
    row, column, in_image = project_to_pixels(origins + 2.0 * directions, camera)
    assert in_image.tolist() == [True] * 4 + [False] * 4
    assert list(zip(column[:4].tolist(), row[:4].tolist(), strict=True)) == [(0, 0), (639, 0), (0, 479), (639, 479)]
    assert not project_to_pixels(origins - 2.0 * directions, camera)[2].any()


def test_scaled_and_cropped_cameras_project_to_the_scaled_and_cropped_image(camera: Camera) -> None:
    points = torch.randn(20, 3, generator=torch.Generator().manual_seed(2)) * 0.5
    pixels_px, _ = project(points, camera)
    torch.testing.assert_close(project(points, camera.scaled(0.5))[0], pixels_px * 0.5, atol=1e-3, rtol=0)
    shifted = project(points, camera.cropped(10, 20, 100, 100))[0]
    torch.testing.assert_close(shifted, pixels_px - torch.tensor([10.0, 20.0]), atol=1e-3, rtol=0)


def test_arrays_round_trip(camera: Camera) -> None:
    again = Camera.from_arrays(
        camera.to_arrays() | {"camera_distortion": np.zeros(0)}
    )  # an extra key of earlier versions
    assert (again.fx, again.fy, again.cx, again.cy, again.width, again.height) == (700, 710, 321, 235, 640, 480)
    np.testing.assert_array_equal(again.world_to_camera, camera.world_to_camera)
