"""Projection through a camera whose intrinsics are estimated, with derivatives."""

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.body.fit.root_placement import MINIMUM_DEPTH_M
from pipeline.geometry.camera import Camera

INTRINSICS_COUNT = 3
"""Entries of an intrinsics delta, relative to the initial camera: shift of the principal point to the right and down in
focal lengths, and logarithm of the ratio of the focal lengths.
"""


def apply_intrinsics_delta(camera: Camera, intrinsics_delta: Float[Tensor, "3"]) -> Camera:
    """Return the initial camera with changed focal length and principal point."""
    right, down, focal_log = intrinsics_delta.tolist()
    fx, fy, scale = camera.fx, camera.fy, math.exp(focal_log)
    return replace(camera, fx=fx * scale, fy=fy * scale, cx=camera.cx + right * fx, cy=camera.cy + down * fy)


def project_with_jacobian(
    world: Float[Tensor, "n m 3"], camera: Camera
) -> tuple[Float[Tensor, "n m 2"], Float[Tensor, "n m 2 3"]]:
    """Return pixels and their derivative with respect to the world point (m).

    The depth is clamped to `MINIMUM_DEPTH_M`.
    """
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
    """Return the derivative of pixels with respect to the intrinsics delta.

    pixels: projected with `intrinsics_delta` applied. camera: the initial camera.
    """
    updated_camera = apply_intrinsics_delta(camera, intrinsics_delta)
    focal_jacobian = pixels - pixels.new_tensor([updated_camera.cx, updated_camera.cy])
    principal_point_jacobian = torch.diag(pixels.new_tensor([camera.fx, camera.fy]))
    return torch.cat([principal_point_jacobian.expand(*pixels.shape, 2), focal_jacobian[..., None]], dim=-1)
