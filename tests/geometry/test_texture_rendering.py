"""Textured renders of a known square against closed forms, and turntable cameras."""

import math

import numpy as np
import pytest
import torch

from pipeline.geometry.camera import Camera, project
from pipeline.geometry.texture_rendering import blur_coverage, render_textured, sample_texture, turntable_camera

SQUARE = torch.tensor([[-1.0, -1.0, -2.0], [1.0, -1.0, -2.0], [1.0, 1.0, -2.0], [-1.0, 1.0, -2.0]])
FACES = torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32)
UV = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


def square_camera(size_px: int) -> Camera:
    """A camera whose image the square of 2 x 2 m at 2 m distance covers exactly."""
    return Camera(float(size_px), float(size_px), size_px / 2, size_px / 2, size_px, size_px)


def test_texel_centres_give_texels_and_corners_repeat_the_border():
    texture = torch.rand(3, 5, 3, generator=torch.Generator().manual_seed(1))
    rows, columns = torch.meshgrid(torch.arange(3), torch.arange(5), indexing="ij")
    uv = torch.stack([(columns + 0.5) / 5, 1.0 - (rows + 0.5) / 3], dim=-1).reshape(-1, 2)
    assert torch.allclose(sample_texture(texture, uv).view(3, 5, 3), texture, atol=1e-6)
    corners = sample_texture(texture, torch.tensor([[0.0, 1.0], [1.0, 0.0]]))
    assert torch.allclose(corners, torch.stack([texture[0, 0], texture[2, 4]]))


def test_sampling_is_differentiable_in_texture_and_position():
    texture = torch.rand(4, 4, 2, dtype=torch.float64, requires_grad=True)
    uv = torch.tensor([[0.31, 0.42], [0.77, 0.58]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(sample_texture, (texture, uv))


def test_a_square_that_faces_the_camera_shows_its_texture_upright():
    texture = torch.rand(8, 8, 3, generator=torch.Generator().manual_seed(2))
    image = render_textured(SQUARE, FACES, FACES, UV, texture, square_camera(8), supersampling=1)
    assert torch.allclose(image[..., :3], texture, atol=1e-5)  # one pixel a texel: row 0 is v = 1, the top
    assert torch.equal(image[..., 3], torch.ones(8, 8))


def test_samples_average_the_texels_under_a_pixel():
    texture = torch.rand(12, 12, 3, generator=torch.Generator().manual_seed(3))
    image = render_textured(SQUARE, FACES, FACES, UV, texture, square_camera(4), supersampling=3)
    assert torch.allclose(image[..., :3], texture.view(4, 3, 4, 3, 3).mean(dim=(1, 3)), atol=1e-5)


def test_coverage_of_a_partly_covered_pixel_is_its_covered_area():
    # 0.25 m is half a pixel of an image with 4 pixels for 2 m.
    shifted = SQUARE + torch.tensor([0.25, 0.0, 0.0])
    image = render_textured(shifted, FACES, FACES, UV, torch.ones(2, 2, 3), square_camera(4), supersampling=4)
    assert image[:, 0, 3].tolist() == pytest.approx([0.5] * 4)
    assert torch.allclose(image[..., :3], image[..., 3:].expand(-1, -1, 3))  # colours are premultiplied


def test_uv_seams_do_not_blend():
    """Two faces that share an edge in space but not in the atlas do not mix their colours."""
    texture = torch.tensor([[[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]])
    uv = torch.tensor([[0.25, 0.5], [0.75, 0.5]])
    faces_uv = torch.tensor([[0, 0, 0], [1, 1, 1]], dtype=torch.int32)
    image = render_textured(SQUARE, FACES, faces_uv, uv, texture, square_camera(6), supersampling=1)[..., :3].reshape(
        -1, 3
    )
    assert {tuple(colour) for colour in image.tolist()} == {(1.0, 0.0, 0.0), (0.0, 0.0, 1.0)}


@pytest.mark.parametrize("angle", [0.0, math.pi / 4, math.pi / 2, math.pi, 4.0])
def test_turntable_camera_shows_the_whole_box_upright(angle):
    lowest, highest = np.array([-0.5, 0.0, -0.2]), np.array([0.6, 1.8, 0.3])
    camera = turntable_camera(lowest, highest, angle, 300, 500)
    corners = torch.tensor([[x, y, z] for x in (-0.5, 0.6) for y in (0.0, 1.8) for z in (-0.2, 0.3)]).float()
    pixels, depth_m = project(corners, camera)
    assert (depth_m > 0).all()
    assert (pixels >= 0).all()
    assert (pixels[:, 0] <= 300).all()
    assert (pixels[:, 1] <= 500).all()
    heights = pixels[:, 1]
    assert heights[corners[:, 1] > 1].max() < heights[corners[:, 1] < 1].min()  # the top of the box is above its bottom
    rotation = camera.world_to_camera[:3, :3]
    assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
    assert np.linalg.det(rotation) == pytest.approx(1.0)


def test_turntable_starts_at_plus_z_and_continues_to_plus_x():
    lowest, highest = np.zeros(3), np.ones(3)
    assert turntable_camera(lowest, highest, 0.0, 9, 9).centre_m()[2] > 5
    assert turntable_camera(lowest, highest, math.pi / 2, 9, 9).centre_m()[0] > 5


def test_a_blurred_outline_has_the_given_blur_and_the_colours_of_the_surface():
    image = np.zeros((40, 60, 4), dtype=np.float32)
    image[:, :30] = [0.2, 0.4, 0.6, 1.0]
    image[20:, :30, 0] = 0.9
    soft = blur_coverage(image, 1.2)
    step = 0.5 * (1 - np.array([math.erf((x + 0.5 - 30) / (1.2 * 2**0.5)) for x in range(60)]))
    np.testing.assert_allclose(soft[5, :, 3], step, atol=0.02)
    covered = soft[..., 3] > 0.01
    np.testing.assert_allclose(soft[..., 1][covered] / soft[..., 3][covered], 0.4, atol=1e-4)
    # An edge between two colours inside the surface is not part of the outline and stays sharp.
    np.testing.assert_allclose(soft[19:21, 10, 0], [0.2, 0.9], atol=1e-4)


def test_a_blur_of_zero_returns_the_image():
    image = np.random.default_rng(0).random((9, 9, 4)).astype(np.float32)
    assert blur_coverage(image, 0.0) is image


def test_shading_multiplies_and_adds_in_linear_rgb() -> None:
    """A grey square under irradiance 0.5, and with radiance 0.1 added; coverage does not change."""
    texture, camera = torch.full((4, 4, 3), 0.5), square_camera(8)
    linear = ((0.5 + 0.055) / 1.055) ** 2.4
    plain = render_textured(SQUARE, FACES, FACES, UV, texture, camera)
    for shading, expected in (
        (torch.tensor([[0.5, 1.0, 0.25]]), [0.5 * linear, linear, 0.25 * linear]),
        (torch.tensor([[0.5, 1.0, 0.25, 0.1]]), [0.5 * linear + 0.1, linear + 0.1, 0.25 * linear + 0.1]),
    ):
        lit = render_textured(SQUARE, FACES, FACES, UV, texture, camera, shading=shading.expand(4, -1))
        srgb = 1.055 * torch.tensor(expected) ** (1 / 2.4) - 0.055
        assert torch.allclose(lit[2:-2, 2:-2, :3], srgb.expand(4, 4, 3), atol=1e-5)
        assert torch.equal(lit[..., 3], plain[..., 3])
