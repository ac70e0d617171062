"""Clay renders of a sphere, whose normals and shading are known in closed form."""

import numpy as np
import pytest
import torch
import trimesh

from pipeline.avatar.clay import (
    ALBEDO,
    AMBIENT_GRADIENT,
    AMBIENT_IRRADIANCE,
    KEY_DIRECTION_CAMERA,
    KEY_IRRADIANCE,
    render_clay,
    render_clay_head,
    shade_clay,
)
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.texture_rendering import turntable_camera


def sphere(subdivisions: int) -> Mesh:
    made = trimesh.creation.icosphere(subdivisions=subdivisions, radius=0.5)
    return Mesh(np.asarray(made.vertices, dtype=np.float32), np.asarray(made.faces, dtype=np.int32))


@pytest.fixture(scope="module")
def ball():
    return render_clay(sphere(4), sphere(4).vertex_normals(), views=4, height_px=120)


def test_normals_of_a_sphere_are_its_directions(ball):
    """Seen from the front the middle faces +Z, from the second side +X; right of the middle is the turned axis."""
    expected = ((0, 0, 1), (1, 0, 0), (0, 0, -1), (-1, 0, 0))
    for view, towards in zip(ball.normals, expected, strict=True):
        height, width = view.shape[:2]
        middle = 2 * (view[height // 2, width // 2, :3] / 255.0) - 1
        assert np.allclose(middle, towards, atol=0.03)
        top = 2 * (view[height // 2 - round(0.3 * width), width // 2, :3] / 255.0) - 1
        assert top[1] == pytest.approx(0.6, abs=0.05)  # 0.3 of the width is 0.6 of the radius
    right = 2 * (ball.normals[0][60, round(0.8 * ball.normals[0].shape[1]), :3] / 255.0) - 1
    assert right[0] == pytest.approx(0.6, abs=0.05)


def test_every_side_has_the_same_light(ball):
    """The key light is fixed to the camera, above and left of it, so all views of a sphere are equal."""
    first = ball.smooth[0].astype(float)
    for view in ball.smooth[1:]:
        assert view.shape == ball.smooth[0].shape
        assert np.abs(view.astype(float) - first).mean() < 1.0
    height, width = first.shape[:2]
    upper_left, lower_right = first[height // 4, width // 4, 0], first[3 * height // 4, 3 * width // 4, 0]
    assert upper_left > lower_right + 60
    assert (first[..., :1] == first[..., :3]).all()


def test_irradiance_is_that_of_one_lamp_and_the_sky():
    """Towards the lamp: key and ambient light add up; away from it there is ambient light alone."""
    camera = turntable_camera(np.zeros(3), np.ones(3), 0.7, 50, 50)
    key = np.array(KEY_DIRECTION_CAMERA) / np.linalg.norm(KEY_DIRECTION_CAMERA)
    towards = camera.world_to_camera[:3, :3].T @ key
    levels = shade_clay(torch.tensor(np.stack([towards, -towards]), dtype=torch.float32), camera.world_to_camera)
    linear = ((levels.numpy() + 0.055) / 1.055) ** 2.4
    assert towards[1] > 0.5
    ambient = AMBIENT_IRRADIANCE + AMBIENT_GRADIENT * np.array([1, -1]) * towards[1]
    assert np.allclose(linear, ALBEDO * (ambient + [KEY_IRRADIANCE, 0.0]), atol=2e-3)


def test_flat_shading_shows_the_triangles():
    """On an icosahedron each face has one level when shaded flat, and many when shaded smoothly."""
    coarse = render_clay(sphere(0), sphere(0).vertex_normals(), views=1, height_px=150)
    inside = coarse.flat[0][..., 3] == 255
    flat, smooth = (len(np.unique(view[0][..., 0][inside])) for view in (coarse.flat, coarse.smooth))
    levels, counts = np.unique(coarse.flat[0][..., 0][inside], return_counts=True)
    assert counts[np.argsort(-counts)][:10].sum() > 0.85 * inside.sum()  # ten faces are visible; edges are blended
    assert smooth > 60
    assert len(levels) == flat


def test_the_head_fills_its_image():
    """A ball on a thin tall post: the ball is the uppermost 15 %."""
    post = trimesh.creation.box(extents=(0.1, 1.7, 0.1)).apply_translation([0, 0.85, 0])
    head = trimesh.creation.icosphere(subdivisions=3, radius=0.15).apply_translation([0, 1.85, 0])
    both = trimesh.util.concatenate([post, head])
    mesh = Mesh(np.asarray(both.vertices, dtype=np.float32), np.asarray(both.faces, dtype=np.int32))
    (view,) = render_clay_head(mesh, mesh.vertex_normals(), views=1, height_px=100)
    rows = np.flatnonzero(view[..., 3].any(axis=1))
    assert rows[0] < 8
    assert rows[-1] > 92
    assert view.shape[1] == pytest.approx(94, abs=8)


def test_clay_is_shaded_with_the_normals_that_are_given():
    """With normals that all point up a sphere has one level, whatever its triangles are; flat shading stays."""
    mesh = sphere(2)
    up = np.tile(np.array([0, 1, 0], dtype=np.float32), (len(mesh.vertices), 1))
    drawn, expected = render_clay(mesh, up, views=1, height_px=100), render_clay(mesh, mesh.vertex_normals(), 1, 100)
    inside = drawn.smooth[0][..., 3] == 255
    assert np.ptp(drawn.smooth[0][..., 0][inside]) <= 1
    assert np.array_equal(drawn.flat[0], expected.flat[0])
