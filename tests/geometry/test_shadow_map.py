"""Shadows against closed forms: the shadow of a ball on the floor, and on its own far half."""

import numpy as np
import torch

from pipeline.geometry.mesh import Mesh
from pipeline.geometry.shadow_map import PCF_RADIUS_PX, SHADOW_TEXEL_M, find_exterior_faces, render_shadow_map
from tests.data_tools.synthetic.shapes import sphere

BALL_M, HEIGHT_M = 0.3, 1.0
KEY_FROM = (0.6, 0.8, 0.0)


def test_shadow_of_a_ball_is_an_ellipse() -> None:
    """Rays along d through a ball of radius r hit the floor in an ellipse of semi-axes r and r / cos of the slant,
    around the foot point of the ray through the middle."""
    vertices, faces = sphere(BALL_M, (0.0, HEIGHT_M, 0.0))
    shadows = render_shadow_map(torch.from_numpy(vertices), torch.from_numpy(faces), KEY_FROM)
    random = np.random.default_rng(0)
    places = np.zeros((4000, 3), dtype=np.float32)
    places[:, [0, 2]] = random.uniform(-1.0, 1.0, (4000, 2)) - [HEIGHT_M * 0.75, 0.0]
    up = np.tile(np.array([0.0, 1.0, 0.0], dtype=np.float32), (4000, 1))
    visibility = shadows.visibility(torch.from_numpy(places), torch.from_numpy(up)).numpy()
    radius = np.hypot((places[:, 0] + HEIGHT_M * 0.75) * 0.8, places[:, 2])
    soft = 2.0 * SHADOW_TEXEL_M * PCF_RADIUS_PX + 0.012
    assert (visibility[radius < BALL_M - soft] == 0).all()
    assert (visibility[radius > BALL_M + soft] == 1).all()
    assert (radius < BALL_M - soft).sum() > 100


def test_far_half_of_a_ball_is_in_shadow() -> None:
    vertices, faces = sphere(BALL_M, (0.0, HEIGHT_M, 0.0))
    normals = torch.from_numpy((vertices - [0.0, HEIGHT_M, 0.0]) / BALL_M).float()
    visibility = render_shadow_map(torch.from_numpy(vertices), torch.from_numpy(faces), KEY_FROM).visibility(
        torch.from_numpy(vertices), normals
    )
    facing = normals @ torch.tensor(KEY_FROM)
    assert (visibility[facing > 0.05] == 1).all()
    assert (visibility[facing < -0.5] == 0).all()


def test_interior_faces_are_not_exterior() -> None:
    """A ball inside a ball is interior; with a hole in the top of the outer ball, its upper side is exterior."""
    (outer, faces), (inner, _) = (sphere(radius_m, (0.0, 1.0, 0.0)) for radius_m in (0.4, 0.2))
    both = np.concatenate([faces, faces + len(outer)])
    seen = find_exterior_faces(Mesh(np.concatenate([outer, inner]), both))
    assert seen[: len(faces)].all()
    assert not seen[len(faces) :].any()
    open_above = faces[(outer[faces][:, :, 1] < 1.25).all(axis=1)]
    holed = find_exterior_faces(Mesh(np.concatenate([outer, inner]), np.concatenate([open_above, faces + len(outer)])))
    height_m = inner[faces].mean(axis=1)[:, 1]
    assert holed[len(open_above) :][height_m > 1.15].all()
    assert not holed[len(open_above) :][height_m < 0.85].any()
