"""Shading by a normal map against Lambert's and Blinn's closed forms, and against the shading of vertices."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipeline.avatar.pixel_shading import NormalMappedMesh
from pipeline.avatar.textured_avatar import TexturedAvatar
from pipeline.geometry.camera import Camera
from pipeline.geometry.texture_rendering import turntable_camera
from pipeline.texture.light import Highlights, VertexGloss, directional_light
from tests.avatar.avatar_sample import sample_body
from tests.stages.report_run import make_avatar

TILT_RAD = np.radians(30.0)
LIGHT = directional_light((1.0, 0.0, 1.0), 0.3)
FLAT_MAP = np.full((8, 8, 3), (0.5, 0.5, 1.0), dtype=np.float32)


def camera() -> Camera:
    half = np.array([0.5, 0.5, 0.05])
    return turntable_camera(-half, half, 0.0, 40, 40)


def square(normal: tuple[float, float, float]) -> NormalMappedMesh:
    """A square that faces +Z with u along +X and v along +Y, and one normal in tangent space."""
    corners = torch.tensor([[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32)
    encoded = 0.5 + 0.5 * np.array(normal, dtype=np.float32)
    return NormalMappedMesh(corners, faces, corners[:, :2] + 0.5, faces, np.tile(encoded, (8, 8, 1)))


@pytest.mark.parametrize(
    ("normal", "expected"),
    [
        ((0.0, 0.0, 1.0), np.cos(np.pi / 4.0)),
        ((np.sin(TILT_RAD), 0.0, np.cos(TILT_RAD)), np.cos(np.pi / 4.0 - TILT_RAD)),
        ((0.0, np.sin(TILT_RAD), np.cos(TILT_RAD)), np.cos(TILT_RAD) * np.cos(np.pi / 4.0)),
    ],
)
def test_a_map_turns_the_normal_towards_u_and_v(normal: tuple[float, float, float], expected: float) -> None:
    shading = square(normal).shade(camera(), LIGHT, None, None)
    assert shading is not None
    assert shading.shape == (40, 40, 3)
    np.testing.assert_allclose(shading[20, 20], 0.3 + expected, atol=1e-4)
    np.testing.assert_allclose(shading[0, 0], shading[20, 20], atol=1e-4)  # outside: that of the nearest pixel


def test_a_highlight_is_where_the_map_turns_the_half_vector() -> None:
    tilt = np.pi / 8.0  # half way from the camera, on +Z, to the lamp
    gloss = VertexGloss(Highlights(LIGHT.key_direction, 40.0), torch.full((4,), 0.25))
    for normal, expected in (((np.sin(tilt), 0.0, np.cos(tilt)), 0.25), ((0.0, 0.0, 1.0), 0.25 * np.cos(tilt) ** 40)):
        shading = square(normal).shade(camera(), LIGHT, None, gloss)
        assert shading is not None
        assert float(shading[20, 20, 3]) == pytest.approx(expected, rel=0.05)


def test_the_exposure_of_the_frame_counts() -> None:
    light = replace(LIGHT, gain=np.array([1.0, 0.5], dtype=np.float32))
    mean, dark = (square((0.0, 0.0, 1.0)).shade(camera(), light, frame, None) for frame in (None, 1))
    assert mean is not None
    assert dark is not None
    np.testing.assert_allclose(dark, 0.5 * mean)


def test_nothing_is_shaded_where_nothing_is_seen() -> None:
    behind = replace(square((0.0, 0.0, 1.0)), vertices_world=square((0.0, 0.0, 1.0)).vertices_world + 100.0)
    assert behind.shade(camera(), LIGHT, None, None) is None


def test_an_avatar_with_a_flat_map_looks_as_without_and_with_another_it_does_not() -> None:
    avatar: TexturedAvatar = make_avatar(sample_body())
    box_m = avatar.vertices.numpy().min(axis=0), avatar.vertices.numpy().max(axis=0)
    view = turntable_camera(*box_m, 0.3, 60, 120)
    tilted = FLAT_MAP.copy()
    tilted[..., 0], tilted[..., 2] = 0.5 + 0.5 * np.sin(TILT_RAD), 0.5 + 0.5 * np.cos(TILT_RAD)
    without, flat, other = (
        replace(avatar, normal_map=each).render(avatar.vertices, view, 2, LIGHT) for each in (None, FLAT_MAP, tilted)
    )
    body = without[..., 3] == 1.0
    assert np.abs(flat - without)[body].mean() < 0.01
    assert np.abs(other - without)[body].mean() > 0.02
    unlit = [replace(avatar, normal_map=each).render(avatar.vertices, view, 2) for each in (None, tilted)]
    np.testing.assert_array_equal(*unlit)
