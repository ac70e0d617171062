"""The geometry of the room: floor points project onto their pixels."""

import numpy as np
import pytest
import torch

from data_tools.synthetic.person.noise import ValueNoise
from data_tools.synthetic.scene.backdrop import WALL_DISTANCE_M, Room, contact_shadow, make_room
from pipeline.geometry.camera import Camera, project

CAMERA = Camera(130.0, 130.0, 50.0, 50.0, 100, 100)
GROUND_M = np.array([0.0, -0.9, -3.0])


@pytest.fixture(scope="module")
def room() -> Room:
    return make_room(CAMERA, GROUND_M, True, ValueNoise(0))


def test_floor_points_project_onto_their_pixels(room: Room) -> None:
    rows, columns = np.nonzero(~np.isnan(room.floor_m[:, :, 0]))
    points = room.floor_m[rows, columns]
    assert np.allclose(points[:, 1], GROUND_M[1], atol=1e-6)
    assert points[:, 2].min() >= GROUND_M[2] - WALL_DISTANCE_M - 1e-6
    position_px, depth_m = project(torch.from_numpy(points).float(), CAMERA)
    assert (depth_m > 0).all()
    assert np.allclose(position_px.numpy(), np.stack([columns, rows], axis=1) + 0.5, atol=1e-2)


def test_floor_covers_the_lower_part_of_the_image(room: Room) -> None:
    """The edge between wall and floor is at row cy + f h / d."""
    corner_px = CAMERA.cy + CAMERA.fy * 0.9 / (3.0 + WALL_DISTANCE_M)
    is_floor = ~np.isnan(room.floor_m[:, 50, 0])
    assert np.flatnonzero(is_floor)[0] == pytest.approx(corner_px, abs=1.0)
    assert is_floor[int(corner_px) + 2 :].all()


def test_shadow_is_darkest_under_the_foot(room: Room) -> None:
    light = contact_shadow(room, GROUND_M[None])
    assert light.min() > 0.5
    assert light.max() == 1.0
    row, column = np.unravel_index(light.argmin(), light.shape)
    foot_px, _ = project(torch.from_numpy(GROUND_M[None]).float(), CAMERA)
    assert np.allclose([column, row], foot_px[0].numpy() - 0.5, atol=1.5)


def test_furniture_is_on_the_wall_only(room: Room) -> None:
    plain = make_room(CAMERA, GROUND_M, False, ValueNoise(0))
    changed = np.abs(plain.image - room.image).max(axis=2) > 1e-6
    assert changed.mean() > 0.05
    assert not changed[~np.isnan(room.floor_m[:, :, 0])].any()
    assert room.image.min() >= 0.0
    assert room.image.max() <= 1.0
