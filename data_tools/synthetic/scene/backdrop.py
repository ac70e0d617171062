"""Render the room behind the synthetic person: wall, floor, optional furniture, and contact shadows of the feet.

All positions are in metres, in the world (+Y up); `ground_m` is the point on the floor where the person stands.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from data_tools.synthetic.person.noise import ValueNoise
from pipeline.geometry.camera import Camera, pixel_rays

WALL_DISTANCE_M = 1.7
"""Distance from the person to the wall behind, along -Z."""

_SAMPLES_PER_AXIS = 3
_WALL, _SKIRTING, _PLANKS = (0.74, 0.75, 0.73), (0.90, 0.90, 0.88), (0.58, 0.44, 0.31)

WallRectangle = tuple[float, float, float, float]
"""Left, right, bottom, top on the wall in metres; the origin is at floor level behind the person."""

_FURNITURE: tuple[tuple[WallRectangle, tuple[float, float, float]], ...] = (
    ((-1.62, -0.78, 0.0, 2.05), (0.88, 0.86, 0.80)),
    ((-1.54, -0.86, 0.0, 1.98), (0.62, 0.50, 0.38)),
    ((-0.98, -0.93, 0.98, 1.06), (0.30, 0.28, 0.26)),
    ((0.72, 1.36, 1.30, 1.82), (0.20, 0.18, 0.17)),
    ((0.76, 1.32, 1.34, 1.78), (0.86, 0.84, 0.78)),
    ((0.84, 1.24, 1.42, 1.60), (0.34, 0.47, 0.55)),
    ((0.84, 1.24, 1.60, 1.70), (0.72, 0.80, 0.84)),
    ((0.62, 1.90, 0.08, 0.46), (0.33, 0.40, 0.38)),
    ((0.62, 1.90, 0.46, 0.86), (0.40, 0.48, 0.45)),
    ((-0.42, -0.18, 0.0, 0.30), (0.66, 0.36, 0.24)),
)


@dataclass(frozen=True)
class Room:
    """The static background.

    Attributes:
        image: sRGB in [0, 1] of the empty room.
        floor_m: world position where the ray of each pixel hits the floor; NaN where it hits the wall.
    """

    image: Float[np.ndarray, "h w 3"]
    floor_m: Float[np.ndarray, "h w 3"]


def make_room(camera: Camera, ground_m: Float[np.ndarray, "3"], is_furnished: bool, noise: ValueNoise) -> Room:
    """Render the empty room.

    Args:
        is_furnished: draw a door, a framed picture, a sofa and a pot; otherwise the wall is bare.
        noise: texture of plaster, furniture and floor boards.
    """
    supersampled_camera = camera.scaled(float(_SAMPLES_PER_AXIS))
    colours = _room_colours(*_intersect_wall_and_floor(supersampled_camera, ground_m), ground_m, is_furnished, noise)
    shape = (camera.height, _SAMPLES_PER_AXIS, camera.width, _SAMPLES_PER_AXIS, 3)
    return Room(colours.reshape(shape).mean(axis=(1, 3)).astype(np.float32), floor_points(camera, ground_m))


def floor_points(camera: Camera, ground_m: Float[np.ndarray, "3"]) -> Float[np.ndarray, "h w 3"]:
    """Intersect the ray of each pixel centre with the floor; NaN where the wall is hit first."""
    return _intersect_wall_and_floor(camera, ground_m)[1].reshape(camera.height, camera.width, 3)


def contact_shadow(room: Room, feet_m: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "h w"]:
    """Compute the factor in (0, 1] by which the feet darken each pixel of the floor: two Gaussians under each foot.

    feet_m: world positions; only x and z are used.
    """
    shadow_factor = np.ones(room.floor_m.shape[:2], dtype=np.float32)
    rows, columns = np.nonzero(~np.isnan(room.floor_m[:, :, 0]))
    points = room.floor_m[rows, columns]
    for foot in feet_m:
        squared = ((points[:, [0, 2]] - foot[[0, 2]]) ** 2).sum(axis=1)
        shadow_factor[rows, columns] *= 1.0 - 0.30 * np.exp(-squared / 0.11**2) - 0.10 * np.exp(-squared / 0.35**2)
    return shadow_factor


def _intersect_wall_and_floor(
    camera: Camera, ground_m: np.ndarray
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Intersect the rays of all pixels with the wall, and with the floor in front of it (NaN where the wall is hit)."""
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    pixels = torch.from_numpy(np.stack([x.ravel(), y.ravel()], axis=1)).float()
    origins, directions = (rays.numpy().astype(np.float64) for rays in pixel_rays(camera, pixels))
    wall_z = ground_m[2] - WALL_DISTANCE_M
    to_wall = (wall_z - origins[:, 2:]) / np.minimum(directions[:, 2:], -1e-6)
    to_floor = (ground_m[1] - origins[:, 1:2]) / np.minimum(directions[:, 1:2], -1e-6)
    floor = np.where(to_floor < to_wall, origins + to_floor * directions, np.nan)
    return origins + to_wall * directions, floor


def _room_colours(
    wall_m: Float[np.ndarray, "n 3"],
    floor_m: Float[np.ndarray, "n 3"],
    ground_m: np.ndarray,
    is_furnished: bool,
    noise: ValueNoise,
) -> Float[np.ndarray, "n 3"]:
    on_floor = ~np.isnan(floor_m[:, 0])
    colours = wall_colours(wall_m - ground_m, is_furnished, noise)
    colours[on_floor] = floor_colours(floor_m[on_floor] - ground_m, noise)
    return np.clip(colours, 0.0, 1.0)


def wall_colours(
    position_m: Float[np.ndarray, "n 3"], is_furnished: bool, noise: ValueNoise
) -> Float[np.ndarray, "n 3"]:
    """Colour plaster with a soft highlight, a skirting board and furniture; position_m is relative to `ground_m`."""
    across, up = position_m[:, 0], position_m[:, 1]
    points = position_m.astype(np.float32)
    plaster = noise.fractal(points, 0.5) * 0.02 + noise(points, 0.01) * 0.008
    shading = 1.0 + 0.10 * np.exp(-((across - 0.6) ** 2 + (up - 1.9) ** 2) / 1.6) - 0.05 * np.clip(1.0 - up, 0.0, 1.0)
    colours = np.asarray(_WALL) * (shading + plaster)[:, None]
    colours[up < 0.09] = np.asarray(_SKIRTING) * shading[up < 0.09, None]
    for (left, right, bottom, top), colour in _FURNITURE if is_furnished else ():
        inside = (across > left) & (across < right) & (up > bottom) & (up < top)
        grain = noise(points[inside], (0.02, 0.25, 0.02)) * 0.05
        colours[inside] = np.asarray(colour) * (shading[inside] * (1.0 + grain))[:, None]
    return colours


def floor_colours(position_m: Float[np.ndarray, "n 3"], noise: ValueNoise) -> Float[np.ndarray, "n 3"]:
    """Colour floor boards along Z, each with its own tone and dark gaps; position_m is relative to `ground_m`."""
    board = np.floor(position_m[:, 0] / 0.14)
    tone = 0.07 * np.sin(12.9898 * board) + noise(position_m.astype(np.float32), (0.012, 1.0, 0.30)) * 0.06
    gap = np.abs(position_m[:, 0] / 0.14 - board - 0.5) > 0.485
    return np.asarray(_PLANKS) * ((1.0 + tone) * np.where(gap, 0.72, 1.0))[:, None]
