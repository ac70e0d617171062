"""Shading and coverage against closed forms: single surface points, and a ball whose silhouette is a disc."""

import numpy as np
import pytest
import torch

from data_tools.synthetic.rig.subject import Subject
from data_tools.synthetic.scene.renderer import (
    FLAT,
    PATCH,
    SHINY,
    STUDIO,
    TWO_SHINES,
    Light,
    face_exponents,
    render_subject,
    shade,
    shiny_faces,
)
from pipeline.body.body import Body
from pipeline.geometry.camera import Camera
from tests.data_tools.synthetic.shapes import sphere

BALL_M, DISTANCE_M = 0.5, 4.0
CAMERA = Camera(200.0, 200.0, 64.0, 64.0, 128, 128)
COLOUR = (200, 100, 50)


def ball() -> Subject:
    vertices, faces = sphere(BALL_M, (0.0, 0.0, -DISTANCE_M))
    weights = np.ones((len(vertices), 1), dtype=np.float32)
    body = Body(("Hips",), np.array([-1], dtype=np.int32), np.zeros((1, 3), np.float32), vertices, faces, weights, {})
    texture = np.tile(np.array(COLOUR, dtype=np.uint8), (4, 4, 1))
    return Subject(body, np.full((len(vertices), 2), 0.5, dtype=np.float32), faces, texture)


def render(light: Light, samples: int = 3, camera: Camera = CAMERA) -> np.ndarray:
    subject = ball()
    return render_subject(subject, torch.from_numpy(subject.body.vertices), camera, light, samples)


def test_coverage_is_the_area_of_the_disc() -> None:
    """A ball of radius r at distance d has the silhouette of a disc with radius f tan(asin(r / d))."""
    radius_px = CAMERA.fx * np.tan(np.arcsin(BALL_M / DISTANCE_M))
    assert render(FLAT)[:, :, 3].sum() == pytest.approx(np.pi * radius_px**2, rel=0.01)


def test_flat_light_shows_the_unlit_texture() -> None:
    image = render(FLAT)
    inside = image[:, :, 3] == 1.0
    assert inside.sum() > 1000
    assert np.allclose(image[inside][:, :3], np.array(COLOUR) / 255.0, atol=1e-3)


def test_colours_are_premultiplied() -> None:
    image = render(FLAT)
    border = (image[:, :, 3] > 0) & (image[:, :, 3] < 1)
    assert border.sum() > 100
    assert np.allclose(image[border][:, :3], image[border][:, 3:] * np.array(COLOUR) / 255.0, atol=1e-3)


def test_subject_outside_the_image_is_not_drawn() -> None:
    camera = Camera(200.0, 200.0, -500.0, 64.0, 128, 128)
    assert not render(STUDIO, camera=camera).any()


def test_cropping_does_not_change_the_render() -> None:
    """A crop of the camera that cuts the ball gives the same pixels."""
    whole, cut = render(STUDIO), render(STUDIO, camera=CAMERA.cropped(50, 40, 40, 60))
    assert np.allclose(whole[40:100, 50:90], cut, atol=2e-2)
    assert np.abs(whole[40:100, 50:90] - cut).mean() < 1e-4


def test_key_light_comes_from_its_side() -> None:
    image = render(Light(key_intensity=0.8, key_direction=(1.0, 0.0, 0.0), ambient_intensity=0.2, sky_gradient=0.0))
    brightness = image[64, :, :3].sum(axis=1)
    assert brightness[76] > 1.3 * brightness[52]


def lit(normal: tuple[float, float, float], light: Light, albedo: float = 0.5) -> float:
    to_camera = torch.tensor([[0.0, 0.0, 1.0]])
    return float(shade(torch.full((1, 3), albedo), torch.tensor([normal]), to_camera, torch.ones(1), light)[0, 0])


def test_shade_against_the_formula() -> None:
    """sRGB 0.5 is 0.21404 in linear colour; a point that faces the key light gets ambient + key times that."""
    light = Light(key_intensity=0.5, key_direction=(0.0, 0.0, 1.0), ambient_intensity=0.7, sky_gradient=0.0)
    linear = 0.21404 * 1.2
    assert lit((0.0, 0.0, 1.0), light) == pytest.approx(1.055 * linear ** (1 / 2.4) - 0.055, abs=1e-4)
    assert lit((0.0, 0.0, -1.0), light) == pytest.approx(1.055 * (0.21404 * 0.7) ** (1 / 2.4) - 0.055, abs=1e-4)


def test_ambient_light_is_stronger_from_above() -> None:
    light = Light(key_intensity=0.0, ambient_intensity=0.8, sky_gradient=0.2)
    assert lit((0.0, 1.0, 0.0), light) > lit((1.0, 0.0, 0.0), light) > lit((0.0, -1.0, 0.0), light)


def test_specular_highlight_is_near_the_mirror_direction() -> None:
    dull = Light(
        key_intensity=SHINY.key_intensity,
        key_direction=SHINY.key_direction,
        ambient_intensity=SHINY.ambient_intensity,
        sky_gradient=SHINY.sky_gradient,
    )
    key = torch.nn.functional.normalize(torch.tensor(SHINY.key_direction), dim=0)
    half = torch.nn.functional.normalize(key + torch.tensor([0.0, 0.0, 1.0]), dim=0)
    mirror = (float(half[0]), float(half[1]), float(half[2]))
    assert lit(mirror, SHINY) > lit(mirror, dull) + 0.1
    assert lit((-1.0, 0.0, 0.0), SHINY) == pytest.approx(lit((-1.0, 0.0, 0.0), dull), abs=1e-6)


def test_a_shiny_patch_is_shiny_inside_and_matte_outside() -> None:
    """The ball's faces between two heights; renders agree with the shiny and with the matte light on either side."""
    subject = ball()
    height = (subject.body.vertices[subject.body.faces, 1].mean(axis=1) + BALL_M) / (2.0 * BALL_M)
    inside = (height > PATCH.shiny_heights[0]) & (height < PATCH.shiny_heights[1])
    assert np.array_equal(shiny_faces(subject, PATCH) > 0, inside)
    patch, shiny, matte = (render(light, samples=1) for light in (PATCH, SHINY, STUDIO))
    like_shiny, like_matte = (np.abs(patch - other).max(axis=2) < 1e-6 for other in (shiny, matte))
    assert (like_shiny | like_matte).all()
    assert (like_shiny & ~like_matte).sum() > 100


def test_two_shines_have_their_own_exponents() -> None:
    """Faces by their height; a highlight is strength * cos(angle)^p above the matte colour, in linear light."""
    subject = ball()
    height = (subject.body.vertices[subject.body.faces, 1].mean(axis=1) + BALL_M) / (2.0 * BALL_M)
    first, second = ((height > low) & (height < high) for low, high in ((0.58, 0.74), (0.3, 0.5)))
    np.testing.assert_array_equal(shiny_faces(subject, TWO_SHINES) > 0, first | second)
    exponents = face_exponents(subject, TWO_SHINES)
    assert set(exponents[first]) == {64.0}
    assert set(exponents[second]) == {16.0}
    light = Light(0.0, (0.0, 0.0, 1.0), 0.0, 0.0, specular_strength=0.35)
    to_camera = torch.tensor([[0.0, 0.0, 1.0]]).repeat(2, 1)
    normal = torch.tensor([[0.0, 0.6, 0.8], [0.0, 0.28, 0.96]])
    found = shade(torch.zeros(2, 3), normal, to_camera, torch.ones(2), light, None, torch.tensor([16.0, 64.0]))
    linear = 0.35 * np.array([0.8**16, 0.96**64])
    srgb = np.where(linear > 0.0031308, 1.055 * linear ** (1 / 2.4) - 0.055, 12.92 * linear)
    np.testing.assert_allclose(found[:, 0].numpy(), srgb, atol=1e-5)
