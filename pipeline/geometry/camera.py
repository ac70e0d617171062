"""The pinhole camera: intrinsics, pose, projection and rays.

Camera axes follow OpenCV: x right, y down, z forward. Pixel centres are at +0.5, so the image covers
[0, width] x [0, height]. `world_to_camera` is a rigid 4x4 matrix that acts on column vectors.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

DEFAULT_WORLD_TO_CAMERA = np.diag([1.0, -1.0, -1.0, 1.0]).astype(np.float32)
"""Default pose: the camera is at the world origin and looks along -Z, with +Y up."""


@dataclass(frozen=True)
class Camera:
    """Pinhole intrinsics in pixels and a rigid pose, for images without lens distortion."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    world_to_camera: Float[np.ndarray, "4 4"] = field(default_factory=DEFAULT_WORLD_TO_CAMERA.copy)

    def scaled(self, factor: float) -> Camera:
        """Return the camera of the image resized by `factor`; the sides are rounded to whole pixels."""
        width, height = max(1, round(self.width * factor)), max(1, round(self.height * factor))
        scale_x, scale_y = width / self.width, height / self.height
        return replace(
            self,
            fx=self.fx * scale_x,
            fy=self.fy * scale_y,
            cx=self.cx * scale_x,
            cy=self.cy * scale_y,
            width=width,
            height=height,
        )

    def cropped(self, left_px: int, top_px: int, width_px: int, height_px: int) -> Camera:
        """Return the camera of a crop of the image with the upper left corner (left_px, top_px)."""
        return replace(self, cx=self.cx - left_px, cy=self.cy - top_px, width=width_px, height=height_px)

    @property
    def intrinsics_px(self) -> tuple[float, float, float, float]:
        """Focal lengths and principal point (fx, fy, cx, cy), px."""
        return self.fx, self.fy, self.cx, self.cy

    def centre_m(self) -> Float[np.ndarray, "3"]:
        """Return the position of the camera centre in the world, m."""
        rotation, translation = self.world_to_camera[:3, :3], self.world_to_camera[:3, 3]
        return -rotation.T @ translation

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the camera as named arrays for an npz file; `from_arrays` is the inverse."""
        return {
            "camera_intrinsics_px": np.array(self.intrinsics_px, dtype=np.float64),
            "camera_size_px": np.array([self.width, self.height], dtype=np.int32),
            "camera_world_to_camera": np.asarray(self.world_to_camera, dtype=np.float32),
        }

    @staticmethod
    def from_arrays(arrays: Mapping[str, np.ndarray]) -> Camera:
        """Build a camera from the result of `to_arrays`; other names in the mapping are ignored."""
        fx, fy, cx, cy = (float(value) for value in arrays["camera_intrinsics_px"])
        width, height = (int(value) for value in arrays["camera_size_px"])
        return Camera(fx, fy, cx, cy, width, height, np.asarray(arrays["camera_world_to_camera"]))


def transform_world_to_camera(points_world: Float[Tensor, "*n 3"], camera: Camera) -> Float[Tensor, "*n 3"]:
    """Transform world points (m) to camera coordinates (m)."""
    pose = torch.as_tensor(camera.world_to_camera, dtype=points_world.dtype, device=points_world.device)
    return points_world @ pose[:3, :3].T + pose[:3, 3]


def project(points_world: Float[Tensor, "*n 3"], camera: Camera) -> tuple[Float[Tensor, "*n 2"], Float[Tensor, "*n"]]:
    """Project world points (m) to pixel positions and depths (m); differentiable.

    The pixel positions of points behind the camera (depth <= 0) are meaningless: mask them by depth.
    """
    points = transform_world_to_camera(points_world, camera)
    depth_m = points[..., 2]
    x_px = camera.fx * points[..., 0] / depth_m + camera.cx
    y_px = camera.fy * points[..., 1] / depth_m + camera.cy
    return torch.stack([x_px, y_px], dim=-1), depth_m


def project_to_pixels(
    points_world: Float[Tensor, "n 3"], camera: Camera
) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"], Bool[np.ndarray, "n"]]:
    """Return row and column of the pixel that contains each projected point, and whether the image shows the point.

    The third array is false for points behind the camera or outside the image; their rows and columns are meaningless.
    """
    position_px, depth_m = project(points_world, camera)
    column, row = (position_px[:, axis].floor().long().numpy() for axis in range(2))
    in_image = (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    return row, column, (depth_m.numpy() > 0) & in_image


def pixel_footprint_m(vertices_world: Float[Tensor, "v 3"], camera: Camera) -> float:
    """Return the length (m) that one pixel covers at the median depth of the vertices: median depth / fx."""
    _, depth_m = project(vertices_world, camera)
    return float(depth_m.median()) / camera.fx


def pixel_rays(camera: Camera, pixels_px: Float[Tensor, "n 2"]) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Return origins (m) and unit directions, in the world, of the rays through pixel positions (centres at +0.5)."""
    pose = torch.as_tensor(camera.world_to_camera, dtype=pixels_px.dtype, device=pixels_px.device)
    in_camera = torch.stack(
        [
            (pixels_px[:, 0] - camera.cx) / camera.fx,
            (pixels_px[:, 1] - camera.cy) / camera.fy,
            torch.ones_like(pixels_px[:, 0]),
        ],
        dim=-1,
    )
    directions = torch.nn.functional.normalize(in_camera @ pose[:3, :3], dim=-1)
    centre = -pose[:3, :3].T @ pose[:3, 3]
    return centre.expand_as(directions), directions
