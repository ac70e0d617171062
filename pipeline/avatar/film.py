"""Frames of a film of the avatar: the unlit texture, on a ground with a grid and a soft shadow, neutral background.

The camera looks at the person a little from above and follows its smoothed path over the ground; the distance is such
that the person is in the picture in every frame.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from scipy.ndimage import gaussian_filter1d
from torch import Tensor

from pipeline.avatar.textured_avatar import TexturedAvatar
from pipeline.body.body import Body, Motion, canonical_to_world
from pipeline.capture.frame_selection import evenly_spaced
from pipeline.geometry.camera import Camera, project
from pipeline.geometry.rotation import axis_angle_to_quaternion
from pipeline.kernels.raster import rasterize

FPS = 24.0
WIDTH_PX, HEIGHT_PX = 1280, 720
SUPERSAMPLING = 2
"""Samples along each side of a pixel: 51.1 dB to pictures of 6, 26 ms a frame on two cores; 3: 55.1 dB, 42 ms."""

FIELD_OF_VIEW_RAD = math.radians(28.0)
ELEVATION_RAD = math.radians(8.0)
MARGIN = 1.12
"""Height and width of the picture in those of the box in which the person moves."""

TURN_S = 6.0
PATH_SMOOTHING_S = 0.6
"""Standard deviation of the Gaussian that smooths the path of the camera."""

BOX_FRAMES = 96
"""Frames of which the box of the moving person is computed, evenly spaced."""

LIGHT_DIRECTION = np.array([-0.45, -1.0, -0.3])
SHADOW_STRENGTH, SHADOW_BLUR_M, SHADOW_SCALE = 0.34, 0.035, 0.5
GRID_M, LINE_M, LINE_STRENGTH = 0.5, 0.012, 0.1
GROUND_FADE_M = 3.0
"""Distance from the person at which the grid has faded to 1/e."""

MIN_FADE = 1e-3

BACKGROUND_TOP, BACKGROUND_BOTTOM = 0.80, 0.93
"""sRGB grey at the upper and lower edge."""


@dataclass(frozen=True)
class Ground:
    """The ground in the rows from `first_row` on; the first axis is the direction across lines of constant x, z.

    x_z_m: point relative to the followed one. width_m: of a pixel. strength: by how much a line darkens the pixel.
    """

    first_row: int
    x_z_m: Float32[np.ndarray, "2 h w"]
    width_m: Float32[np.ndarray, "2 h w"]
    strength: Float32[np.ndarray, "2 h w"]

    def line_darkness(self, point_m: Float[np.ndarray, "3"]) -> Float32[np.ndarray, "h w"]:
        """Return by which share the lines darken each pixel when the camera follows `point_m`."""
        darkness = np.zeros(self.x_z_m.shape[1:], np.float32)
        for axis, start_m in enumerate(point_m[[0, 2]]):
            to_line_m = self.x_z_m[axis] + np.float32(start_m)
            to_line_m -= np.float32(GRID_M) * np.rint(to_line_m * np.float32(1.0 / GRID_M))
            covered = np.float32(0.5 * LINE_M) - np.abs(to_line_m, out=to_line_m)
            covered /= self.width_m[axis]
            covered += np.float32(0.5)  # a ramp of the width of a pixel
            np.clip(covered, 0.0, 1.0, out=covered)
            np.maximum(darkness, covered * self.strength[axis], out=darkness)
        return darkness


@dataclass(frozen=True)
class FilmView:
    """The camera relative to the point of the ground that it follows; +Y up, the camera looks from +Z.

    box_m: lower and upper corner of the box in which the person moves, relative to that point.
    """

    box_m: Float[np.ndarray, "2 3"]

    @cached_property
    def camera(self) -> Camera:
        """The camera for the origin as the point on the ground."""
        centre, size = self.box_m.mean(axis=0), np.ptp(self.box_m, axis=0)
        focal_px = 0.5 * HEIGHT_PX / math.tan(0.5 * FIELD_OF_VIEW_RAD)
        radius_m = 0.5 * math.hypot(size[0], size[2])
        height_m = size[1] * math.cos(ELEVATION_RAD) + size[2] * math.sin(ELEVATION_RAD)
        nearest_m = max(focal_px * MARGIN * height_m / HEIGHT_PX, focal_px * MARGIN * size[0] / WIDTH_PX) + radius_m
        cos, sin = math.cos(ELEVATION_RAD), math.sin(ELEVATION_RAD)
        rotation = np.array([[1.0, 0.0, 0.0], [0.0, -cos, sin], [0.0, -sin, -cos]])
        world_to_camera = np.eye(4, dtype=np.float32)
        world_to_camera[:3, :3] = rotation
        world_to_camera[:3, 3] = -rotation @ (centre - nearest_m * rotation[2])
        return Camera(focal_px, focal_px, WIDTH_PX / 2.0, HEIGHT_PX / 2.0, WIDTH_PX, HEIGHT_PX, world_to_camera)

    def at(self, point_m: Float[np.ndarray, "3"]) -> Camera:
        """Return the camera for a point on the ground."""
        world_to_camera = self.camera.world_to_camera.copy()
        world_to_camera[:3, 3] -= world_to_camera[:3, :3] @ point_m
        return replace(self.camera, world_to_camera=world_to_camera)

    @cached_property
    def ground(self) -> Ground:
        """The part of the picture that shows the ground near the followed point."""
        camera = self.camera
        columns, rows = np.arange(WIDTH_PX) + 0.5 - camera.cx, np.arange(HEIGHT_PX) + 0.5 - camera.cy
        rays = (
            np.stack([*np.broadcast_arrays(columns / camera.fx, rows[:, None] / camera.fy, 1.0)], axis=-1)
            @ camera.world_to_camera[:3, :3]
        )
        centre_m = camera.centre_m()
        is_ground = rays[..., 1] < -1e-4
        distance = np.where(is_ground, -centre_m[1] / np.where(is_ground, rays[..., 1], -1.0), 1e3)
        x_z_m = np.moveaxis((centre_m + distance[..., None] * rays)[..., [0, 2]], -1, 0)
        fade = np.exp(-((x_z_m**2).sum(axis=0) / GROUND_FADE_M**2)) * is_ground
        first_row = int(np.argmax(fade.max(axis=1) > MIN_FADE))
        x_z_m, fade = x_z_m[:, first_row:], fade[first_row:]
        width_m = np.maximum(np.abs(np.gradient(x_z_m, axis=1)) + np.abs(np.gradient(x_z_m, axis=2)), 1e-6)
        strength = LINE_STRENGTH * fade * np.minimum(1.0, LINE_M / width_m)
        return Ground(first_row, *(values.astype(np.float32) for values in (x_z_m, width_m, strength)))


def turntable_motion(body: Body, floor_y_m: float) -> Motion:
    """Return one turn of the A-pose about the vertical through the hips, at `FPS`; the frame after it is the first.

    floor_y_m: height of the origin of the A-pose.
    """
    count = round(TURN_S * FPS)
    angle_rad = 2.0 * np.pi * np.arange(count) / count
    axis_angle = torch.zeros(count, 3, dtype=torch.float64)
    axis_angle[:, 1] = torch.from_numpy(angle_rad)
    rotations = np.tile(np.array([1.0, 0.0, 0.0, 0.0], np.float32), (count, len(body.joint_names), 1))
    rotations[:, 0] = axis_angle_to_quaternion(axis_angle).numpy()
    root_m = np.tile(body.joints_m[:1] + np.array([0.0, floor_y_m, 0.0], np.float32), (count, 1)).astype(np.float32)
    return Motion(np.arange(count, dtype=np.int32), np.arange(count) / FPS, rotations, root_m)


def render_film(avatar: TexturedAvatar, body: Body, motion: Motion) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """Render every frame of a motion; sRGB of `HEIGHT_PX` x `WIDTH_PX`.

    Args:
        avatar: the mesh in the A-pose of `body`.
        body: the skeleton.
        motion: at `FPS`, on a floor at y = 0.
    """
    transforms = canonical_to_world(body, motion)
    path_m = _camera_path_m(motion)
    view = FilmView(_moving_box_m(avatar, transforms, path_m))
    background, background_at_m = np.empty(0, np.float32), None
    for pose, point_m in zip(transforms, path_m, strict=True):
        if background_at_m is None or not np.array_equal(point_m, background_at_m):
            background, background_at_m = _background(view, point_m), point_m
        yield _render_frame(avatar, avatar.pose_vertices(pose), view.at(point_m), background)


def _render_frame(
    avatar: TexturedAvatar, vertices_world: Float[Tensor, "v 3"], camera: Camera, background: Float32[np.ndarray, "h w"]
) -> UInt8[np.ndarray, "h w 3"]:
    """Render one pose before a grey background in [0, 255]."""
    shadow = _shadow(vertices_world, avatar, camera)
    grey = background * (np.float32(1.0) - np.float32(SHADOW_STRENGTH) * shadow)
    image = cv2.cvtColor(cv2.convertScaleAbs(grey), cv2.COLOR_GRAY2RGB)
    left, top, right, bottom = _pixel_box(vertices_world, camera)
    if right > left and bottom > top:
        crop = camera.cropped(left, top, right - left, bottom - top)
        person = avatar.render(vertices_world, crop, SUPERSAMPLING)
        window = 255.0 * person[..., :3] + (1.0 - person[..., 3:]) * grey[top:bottom, left:right, None]
        image[top:bottom, left:right] = cv2.convertScaleAbs(window)
    return image


def _camera_path_m(motion: Motion) -> Float[np.ndarray, "n 3"]:
    """Return the smoothed position of the hips on the ground."""
    path_m = motion.root_translation_m.astype(np.float64) * [1.0, 0.0, 1.0]
    return gaussian_filter1d(path_m, PATH_SMOOTHING_S * FPS, axis=0, mode="nearest")


def _moving_box_m(
    avatar: TexturedAvatar, transforms: Float[Tensor, "n j 4 4"], path_m: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "2 3"]:
    """Return the corners of the box of all poses, relative to the camera's path; the ground is inside."""
    rows = evenly_spaced(len(transforms), BOX_FRAMES)
    low_m, high_m = np.zeros(3), np.zeros(3)
    for row in rows.tolist():
        vertices_m = avatar.pose_vertices(transforms[row]).numpy() - path_m[row]
        low_m, high_m = np.minimum(low_m, vertices_m.min(axis=0)), np.maximum(high_m, vertices_m.max(axis=0))
    return np.stack([low_m, high_m])


def _background(view: FilmView, point_m: Float[np.ndarray, "3"]) -> Float32[np.ndarray, "h w"]:
    """Return background and ground, grey in [0, 255]: a gradient, and a grid that fades with the distance."""
    column = np.linspace(BACKGROUND_TOP, BACKGROUND_BOTTOM, HEIGHT_PX, dtype=np.float32)
    grey = np.repeat(np.float32(255.0) * column[:, None], WIDTH_PX, axis=1)
    grey[view.ground.first_row :] *= np.float32(1.0) - view.ground.line_darkness(point_m)
    return grey


def _shadow(vertices_world: Float[Tensor, "v 3"], avatar: TexturedAvatar, camera: Camera) -> Float32[np.ndarray, "h w"]:
    """Return the blurred shadow on the ground at y = 0 of a light from `LIGHT_DIRECTION`, in [0, 1]."""
    direction = torch.tensor(LIGHT_DIRECTION, dtype=vertices_world.dtype)
    height_m = vertices_world[:, 1:].narrow(1, 0, 1).clamp_min(0.0)
    on_ground = vertices_world - height_m / direction[1] * direction
    on_ground[:, 1] = 0.0
    small = camera.scaled(SHADOW_SCALE)
    pixels, depth_m = project(on_ground, small)
    face_id, _, _ = rasterize(pixels, depth_m, avatar.faces, small.height, small.width)
    sigma_px = SHADOW_BLUR_M * small.fx / float(depth_m.median())
    blurred = cv2.GaussianBlur((face_id.numpy() >= 0).astype(np.float32), (0, 0), sigma_px)
    return cv2.resize(blurred, (WIDTH_PX, HEIGHT_PX), interpolation=cv2.INTER_LINEAR)


def _pixel_box(vertices_world: Float[Tensor, "v 3"], camera: Camera) -> tuple[int, int, int, int]:
    """Return left, top, right and bottom of the vertices in the picture, px."""
    pixels, _ = project(vertices_world, camera)
    left, top = (int(value) for value in pixels.amin(dim=0).floor())
    right, bottom = (int(value) for value in pixels.amax(dim=0).ceil())
    return max(left, 0), max(top, 0), min(right, WIDTH_PX), min(bottom, HEIGHT_PX)
