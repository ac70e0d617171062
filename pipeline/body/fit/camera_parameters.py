"""The camera as a fit has it: the given one, seen through the lens that is sought."""

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.body.fit.root_placement import MINIMUM_DEPTH_M
from pipeline.geometry.camera import Camera

INTRINSICS_COUNT = 3
"""Numbers of a lens: shift of the principal point to the right and down, and logarithm of the focal length; all over
the focal length of the given camera.
"""


def apply_intrinsics_delta(camera: Camera, intrinsics_delta: Float[Tensor, "3"]) -> Camera:
    """The given camera with a lens's focal length and principal point."""
    right, down, focal_log = intrinsics_delta.tolist()
    fx, fy, scale = camera.fx, camera.fy, math.exp(focal_log)
    return replace(camera, fx=fx * scale, fy=fy * scale, cx=camera.cx + right * fx, cy=camera.cy + down * fy)


def project_with_jacobian(
    world: Float[Tensor, "n m 3"], camera: Camera
) -> tuple[Float[Tensor, "n m 2"], Float[Tensor, "n m 2 3"]]:
    """Pixels and their derivative by the world point (m)."""
    pose = torch.as_tensor(camera.world_to_camera, dtype=world.dtype)
    x, y, depth = (world @ pose[:3, :3].T + pose[:3, 3]).unbind(-1)
    depth = depth.clamp(min=MINIMUM_DEPTH_M)
    fx, fy, zero = camera.fx, camera.fy, torch.zeros_like(x)
    pixels = torch.stack([fx * x / depth + camera.cx, fy * y / depth + camera.cy], dim=-1)
    in_camera = torch.stack(
        [
            torch.stack([fx / depth, zero, -fx * x / depth**2], dim=-1),
            torch.stack([zero, fy / depth, -fy * y / depth**2], dim=-1),
        ],
        dim=-2,
    )
    return pixels, in_camera @ pose[:3, :3]


def compute_intrinsics_jacobian(
    pixels: Float[Tensor, "n m 2"], camera: Camera, intrinsics_delta: Float[Tensor, "3"]
) -> Float[Tensor, "n m 2 3"]:
    """Derivative of projections by the lens that the given camera is seen through."""
    updated_camera = apply_intrinsics_delta(camera, intrinsics_delta)
    focal_jacobian = pixels - pixels.new_tensor([updated_camera.cx, updated_camera.cy])
    principal_point_jacobian = torch.diag(pixels.new_tensor([camera.fx, camera.fy]))
    return torch.cat([principal_point_jacobian.expand(*pixels.shape, 2), focal_jacobian[..., None]], dim=-1)
