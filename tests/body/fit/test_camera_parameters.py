import pytest
import torch

from pipeline.body.fit.camera_parameters import (
    apply_intrinsics_delta,
    compute_intrinsics_jacobian,
    project_with_jacobian,
)
from pipeline.body.fit.root_placement import MINIMUM_DEPTH_M
from pipeline.geometry.camera import Camera, project

CAMERA = Camera(300.0, 310.0, 140.0, 90.0, 256, 200)
INTRINSICS_DELTA = torch.tensor([0.02, -0.01, 0.1], dtype=torch.float64)


def points() -> torch.Tensor:
    random = torch.rand(2, 5, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return random - torch.tensor([0.5, 0.5, 3.5], dtype=torch.float64)


def test_intrinsics_delta_is_relative_to_the_focal_length() -> None:
    camera = apply_intrinsics_delta(CAMERA, INTRINSICS_DELTA)
    assert camera.fx / CAMERA.fx == pytest.approx(1.10517, rel=1e-5)
    assert camera.fy / CAMERA.fy == pytest.approx(1.10517, rel=1e-5)
    assert (camera.cx, camera.cy) == pytest.approx((140.0 + 6.0, 90.0 - 3.1))
    assert (camera.width, camera.height) == (256, 200)


def test_projection_equals_that_of_the_camera() -> None:
    camera = apply_intrinsics_delta(CAMERA, INTRINSICS_DELTA)
    pixels, _ = project_with_jacobian(points(), camera)
    torch.testing.assert_close(pixels.view(-1, 2), project(points().view(-1, 3), camera)[0])


def test_depth_behind_the_camera_is_clamped() -> None:
    behind = torch.tensor([[[0.02, 0.0, 1.0]]], dtype=torch.float64)
    pixels, pixel_jacobian = project_with_jacobian(behind, CAMERA)
    assert pixels[0, 0].tolist() == pytest.approx([300.0 * 0.02 / MINIMUM_DEPTH_M + 140.0, 90.0])
    assert pixel_jacobian.isfinite().all()


def test_jacobians_agree_with_differences() -> None:
    def pixels(world: torch.Tensor, intrinsics_delta: torch.Tensor) -> torch.Tensor:
        return project_with_jacobian(world, apply_intrinsics_delta(CAMERA, intrinsics_delta))[0]

    step = 1e-6
    camera = apply_intrinsics_delta(CAMERA, INTRINSICS_DELTA)
    intrinsics_jacobian = compute_intrinsics_jacobian(pixels(points(), INTRINSICS_DELTA), CAMERA, INTRINSICS_DELTA)
    pixel_jacobian = project_with_jacobian(points(), camera)[1]
    for axis, unit in enumerate(step * torch.eye(3, dtype=torch.float64)):
        numeric = (pixels(points(), INTRINSICS_DELTA + unit) - pixels(points(), INTRINSICS_DELTA - unit)) / (2 * step)
        torch.testing.assert_close(intrinsics_jacobian[..., axis], numeric, atol=1e-5, rtol=1e-6)
        numeric = (pixels(points() + unit, INTRINSICS_DELTA) - pixels(points() - unit, INTRINSICS_DELTA)) / (2 * step)
        torch.testing.assert_close(pixel_jacobian[..., axis], numeric, atol=1e-5, rtol=1e-6)
