"""Position of the root in perspective coordinates: (x / z, y / z, log z) in camera axes, z in metres.

An image does not determine whether a person is small and near or tall and far. In these coordinates a motion is equally
smooth at either scale, so that no term of the fit shrinks the world.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.geometry.camera import Camera, transform_world_to_camera

MINIMUM_DEPTH_M = 0.2


def world_to_perspective(root_m: Float[Tensor, "n 3"], camera: Camera) -> Float[Tensor, "n 3"]:
    """Return perspective coordinates of world positions; the depth is clamped to `MINIMUM_DEPTH_M`."""
    x, y, depth_m = transform_world_to_camera(root_m, camera).unbind(-1)
    depth_m = depth_m.clamp(min=MINIMUM_DEPTH_M)
    return torch.stack([x / depth_m, y / depth_m, depth_m.log()], dim=-1)


def perspective_to_world(root_perspective: Float[Tensor, "n 3"], camera: Camera) -> Float[Tensor, "n 3"]:
    """Return world positions (m); inverse of `world_to_perspective`."""
    pose = torch.as_tensor(camera.world_to_camera, dtype=root_perspective.dtype)
    ray = torch.cat([root_perspective[:, :2], torch.ones_like(root_perspective[:, :1])], dim=-1)
    return (ray * root_perspective[:, 2:].exp() - pose[:3, 3]) @ pose[:3, :3]


def root_jacobian(root_m: Float[Tensor, "n 3"], camera: Camera) -> Float[Tensor, "n 3 3"]:
    """Return the derivative of the world position with respect to the perspective coordinates."""
    pose = torch.as_tensor(camera.world_to_camera, dtype=root_m.dtype)
    in_camera = transform_world_to_camera(root_m, camera)
    depth_m, zero = in_camera[:, 2].clamp(min=MINIMUM_DEPTH_M), torch.zeros(len(root_m), dtype=root_m.dtype)
    sideways = torch.stack([depth_m, zero, zero], dim=-1)
    downward = torch.stack([zero, depth_m, zero], dim=-1)
    return pose[:3, :3].T @ torch.stack([sideways, downward, in_camera], dim=-1)


def line_of_sight_rotation(
    direction: Float[Tensor, "n 2"],
) -> tuple[Float[Tensor, "n 3 3"], Float[Tensor, "n 2 3 3"]]:
    """Return the smallest rotations from camera axes to those whose z axis is a line of sight, and their derivative.

    direction: of the lines, (x / z, y / z) in camera axes.
    """
    length = torch.linalg.norm(torch.nn.functional.pad(direction, (0, 1), value=1.0), dim=1)
    across, along = direction / length[:, None], 1.0 / length  # of the unit vectors of the lines
    unit = torch.cat([across, along[:, None]], dim=1)
    unit_jacobian = (torch.eye(3).to(unit)[:2] - across[:, :, None] * unit[:, None]) / length[:, None, None]
    factor = 1.0 / (1.0 + along)
    factor_jacobian = -factor[:, None].square() * unit_jacobian[:, :, 2]
    outer = across[:, :, None] * across[:, None]
    rotation, jacobian = unit.new_zeros(len(unit), 3, 3), unit.new_zeros(len(unit), 2, 3, 3)
    rotation[:, :2, :2] = torch.eye(2).to(unit) - factor[:, None, None] * outer
    rotation[:, :2, 2], rotation[:, 2] = -across, unit
    half = unit_jacobian[:, :, :2, None] * across[:, None, None]
    jacobian[:, :, :2, :2] = -factor_jacobian[:, :, None, None] * outer[:, None]
    jacobian[:, :, :2, :2] -= factor[:, None, None, None] * (half + half.transpose(2, 3))
    jacobian[:, :, :2, 2], jacobian[:, :, 2] = -unit_jacobian[:, :, :2], unit_jacobian
    return rotation, jacobian
