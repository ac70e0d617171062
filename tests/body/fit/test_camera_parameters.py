import pytest
import torch

from pipeline.body.fit.camera_parameters import pixels_by_lens, project_with_covectors, through_lens
from pipeline.body.fit.root_placement import MINIMUM_DEPTH_M
from pipeline.geometry.camera import Camera, project

CAMERA = Camera(300.0, 310.0, 140.0, 90.0, 256, 200)
LENS = torch.tensor([0.02, -0.01, 0.1], dtype=torch.float64)


def points() -> torch.Tensor:
    random = torch.rand(2, 5, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return random - torch.tensor([0.5, 0.5, 3.5], dtype=torch.float64)


def test_a_lens_counts_in_focal_lengths() -> None:
    camera = through_lens(CAMERA, LENS)
    assert camera.fx / CAMERA.fx == pytest.approx(1.10517, rel=1e-5)
    assert camera.fy / CAMERA.fy == pytest.approx(1.10517, rel=1e-5)
    assert (camera.cx, camera.cy) == pytest.approx((140.0 + 6.0, 90.0 - 3.1))
    assert (camera.width, camera.height) == (256, 200)


def test_pixels_are_those_of_the_camera() -> None:
    camera = through_lens(CAMERA, LENS)
    pixels, _ = project_with_covectors(points(), camera)
    torch.testing.assert_close(pixels.view(-1, 2), project(points().view(-1, 3), camera)[0])


def test_a_point_behind_the_camera_is_taken_as_just_before_it() -> None:
    behind = torch.tensor([[[0.02, 0.0, 1.0]]], dtype=torch.float64)
    pixels, covectors = project_with_covectors(behind, CAMERA)
    assert pixels[0, 0].tolist() == pytest.approx([300.0 * 0.02 / MINIMUM_DEPTH_M + 140.0, 90.0])
    assert covectors.isfinite().all()


def test_derivatives_are_differences() -> None:
    def pixels(world: torch.Tensor, lens: torch.Tensor) -> torch.Tensor:
        return project_with_covectors(world, through_lens(CAMERA, lens))[0]

    step = 1e-6
    camera = through_lens(CAMERA, LENS)
    by_lens = pixels_by_lens(pixels(points(), LENS), CAMERA, LENS)
    covectors = project_with_covectors(points(), camera)[1]
    for axis, unit in enumerate(step * torch.eye(3, dtype=torch.float64)):
        numeric = (pixels(points(), LENS + unit) - pixels(points(), LENS - unit)) / (2 * step)
        torch.testing.assert_close(by_lens[..., axis], numeric, atol=1e-5, rtol=1e-6)
        numeric = (pixels(points() + unit, LENS) - pixels(points() - unit, LENS)) / (2 * step)
        torch.testing.assert_close(covectors[..., axis], numeric, atol=1e-5, rtol=1e-6)
