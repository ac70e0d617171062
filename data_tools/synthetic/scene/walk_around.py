"""A camera that someone carries around a person who stands still.

All is described as that camera sees it: the person turns before it, and room and light turn with the person. Steps of
who walks move the person up and down, nearer and farther.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Float

from data_tools.synthetic.person.noise import ValueNoise
from data_tools.synthetic.scene.backdrop import Room, floor_colours, floor_points, wall_colours
from data_tools.synthetic.scene.renderer import Light
from pipeline.geometry.camera import Camera, pixel_rays

_SHIFTS_M = (
    ((0.31, 0.030), (0.90, 0.012)),
    ((0.13, 0.020), (1.80, 0.012)),
    ((0.17, 0.120), (0.41, 0.050)),
)
"""Frequencies (Hz) and amplitudes (m) of the person's shift to the right, up and away from the camera."""
_CELL_M, _WALL_HEIGHT_M, _FURNITURE_PERIOD_M = 0.005, 4.0, 4.0
_MIN_HALF_SIDE_M, _MARGIN_M = 4.0, 0.4
"""From the middle to a wall, and between the path of the camera and the walls."""
_SAMPLES_PER_AXIS = 2
_REMAPPED = 2**14
"""Rays at once: OpenCV's maps have less than 2^15 rows."""


def walking_shift_m(time_s: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n 3"]:
    """Return by how much the person is displaced in the axes of the camera's world; equal times give equal shifts."""
    shift = np.zeros((len(time_s), 3))
    for axis, waves in enumerate(_SHIFTS_M):
        for frequency, amplitude_m in waves:
            shift[:, axis] += amplitude_m * np.sin(2.0 * np.pi * frequency * time_s + 2.0 * axis + 5.0 * frequency)
    return shift


@dataclass(frozen=True)
class Surroundings:
    """A square room with the person in the middle of its floor.

    Attributes:
        half_side_m: from the middle to each wall.
        walls: sRGB in [0, 1] of the walls at +X, -X, +Z and -Z; rows go down from `_WALL_HEIGHT_M`.
        floor: sRGB in [0, 1]; rows along Z, columns along X.
    """

    half_side_m: float
    walls: Float[np.ndarray, "4 h w 3"]
    floor: Float[np.ndarray, "w w 3"]

    def seen_by(self, camera: Camera, ground_m: Float[np.ndarray, "3"], turn_rad: float) -> Room:
        """Render the empty room, turned by this angle about the vertical through `ground_m`."""
        fine = camera.scaled(float(_SAMPLES_PER_AXIS))
        y, x = np.mgrid[: fine.height, : fine.width] + 0.5
        pixels = torch.from_numpy(np.stack([x.ravel(), y.ravel()], axis=1)).float()
        origins, directions = (rays.numpy().astype(np.float64) for rays in pixel_rays(fine, pixels))
        to_room = _rotation_about_y(-turn_rad).T
        colours = self._colours((origins - ground_m) @ to_room, directions @ to_room)
        shape = (camera.height, _SAMPLES_PER_AXIS, camera.width, _SAMPLES_PER_AXIS, 3)
        return Room(colours.reshape(shape).mean(axis=(1, 3)), floor_points(camera, ground_m))

    def _colours(
        self, origins_m: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]
    ) -> Float[np.ndarray, "n 3"]:
        """Return the colour of the first surface that each ray hits."""
        down = np.minimum(directions[:, 1], -1e-9)
        nearest = -origins_m[:, 1] / down
        points_m = origins_m + nearest[:, None] * directions
        colours = _sample(self.floor, points_m[:, 2] + self.half_side_m, points_m[:, 0] + self.half_side_m)
        for wall, (axis, sign) in enumerate(((0, 1.0), (0, -1.0), (2, 1.0), (2, -1.0))):
            towards = sign * directions[:, axis]
            distance = (self.half_side_m - sign * origins_m[:, axis]) / np.maximum(towards, 1e-9)
            hit = np.flatnonzero((towards > 1e-9) & (distance < nearest))
            nearest[hit] = distance[hit]
            points_m = origins_m[hit] + distance[hit, None] * directions[hit]
            row_m = _WALL_HEIGHT_M - points_m[:, 1]
            colours[hit] = _sample(self.walls[wall], row_m, points_m[:, 2 - axis] + self.half_side_m)
        return colours


def make_surroundings(
    camera: Camera, ground_m: Float[np.ndarray, "3"], is_furnished: bool, noise: ValueNoise
) -> Surroundings:
    """Return the room around the person; all four walls are furnished alike, each from another place on.

    Arguments are those of `data_tools.synthetic.scene.backdrop.make_room`.
    """
    half_side_m = max(_MIN_HALF_SIDE_M, float(np.linalg.norm((camera.centre_m() - ground_m)[[0, 2]])) + _MARGIN_M)
    along_m = np.arange(-half_side_m, half_side_m, _CELL_M)
    up_m = np.arange(_WALL_HEIGHT_M, 0.0, -_CELL_M)
    walls = []
    for wall in range(4):
        across_m = (along_m + 0.9 * wall) % _FURNITURE_PERIOD_M - 0.5 * _FURNITURE_PERIOD_M
        y, x = np.meshgrid(up_m, across_m, indexing="ij")
        points_m = np.stack([x, y, np.full_like(x, 3.0 * wall)], axis=-1)
        walls.append(wall_colours(points_m.reshape(-1, 3), is_furnished, noise).reshape(points_m.shape))
    z, x = np.meshgrid(along_m, along_m, indexing="ij")
    points_m = np.stack([x, np.zeros_like(x), z], axis=-1)
    floor = floor_colours(points_m.reshape(-1, 3), noise).reshape(points_m.shape)
    return Surroundings(half_side_m, *(np.clip(part, 0.0, 1.0).astype(np.float32) for part in (np.stack(walls), floor)))


def turned_light(light: Light, turn_rad: float) -> Light:
    """Return the light that turns with the room."""
    x, y, z = _rotation_about_y(turn_rad) @ light.key_direction
    return replace(light, key_direction=(float(x), float(y), float(z)))


def _rotation_about_y(angle_rad: float) -> Float[np.ndarray, "3 3"]:
    cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])


def _sample(
    picture: Float[np.ndarray, "h w 3"], row_m: Float[np.ndarray, "n"], column_m: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n 3"]:
    """Interpolate a picture of cells of `_CELL_M`, mirrored at its edges."""
    row, column = (np.clip(position_m / _CELL_M, -1e4, 1e4).astype(np.float32) for position_m in (row_m, column_m))
    parts = [
        cv2.remap(
            picture,
            column[k : k + _REMAPPED, None],
            row[k : k + _REMAPPED, None],
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REFLECT_101,
        )[:, 0]
        for k in range(0, len(row), _REMAPPED)
    ]
    return np.concatenate([np.empty((0, 3), np.float32), *parts])
