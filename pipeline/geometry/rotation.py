"""Rotations in PyTorch, batched over leading axes. Quaternions are unit quaternions in the order w, x, y, z."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

_SKEW_SYMMETRIC_BASIS = torch.tensor(
    [
        [0, 0, 0, 0, 0, -1, 0, 1, 0],
        [0, 0, 1, 0, 0, 0, -1, 0, 0],
        [0, -1, 0, 1, 0, 0, 0, 0, 0],
    ]
)
"""Row k is the flattened derivative of the cross-product matrix of a vector with respect to its component k."""


def axis_angle_to_quaternion(axis_angle_rad: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 4"]:
    """Convert axis-angle vectors (rad) to quaternions (exponential map); differentiable at zero by a Taylor series."""
    squared = (axis_angle_rad**2).sum(-1, keepdim=True)
    small = squared < 1e-8
    angle = torch.where(small, torch.ones_like(squared), squared).sqrt()
    scale = torch.where(small, 0.5 - squared / 48.0, torch.sin(0.5 * angle) / angle)
    w = torch.where(small, 1.0 - squared / 8.0, torch.cos(0.5 * angle))
    return torch.cat([w, axis_angle_rad * scale], dim=-1)


def quaternion_to_axis_angle(quaternion_wxyz: Float[Tensor, "*n 4"]) -> Float[Tensor, "*n 3"]:
    """Convert quaternions to axis-angle vectors (logarithm map) with angles in [0, pi] rad; no gradient at zero."""
    w, vector = quaternion_wxyz[..., :1], quaternion_wxyz[..., 1:]
    sine = vector.norm(dim=-1, keepdim=True)
    half_angle = torch.atan2(sine, w.abs())
    scale = torch.where(sine > 0.0, 2.0 * half_angle / sine, 2.0)
    return torch.where(w < 0.0, -scale, scale) * vector


def quaternion_to_matrix(quaternion_wxyz: Float[Tensor, "*n 4"]) -> Float[Tensor, "*n 3 3"]:
    """Convert quaternions to rotation matrices; the quaternions are normalised first."""
    w, x, y, z = torch.nn.functional.normalize(quaternion_wxyz, dim=-1).unbind(-1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], dim=-1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], dim=-1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], dim=-1),
    ]
    return torch.stack(rows, dim=-2)


def axis_angle_to_matrix(axis_angle_rad: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3 3"]:
    """Convert axis-angle vectors (rad) to matrices by Rodrigues' formula, I + sin(a)/a K + (1 - cos(a))/a² K².

    Near zero both factors are evaluated by their Taylor series.
    """
    squared = (axis_angle_rad**2).sum(-1)[..., None, None]
    small = squared < 1e-4
    safe = torch.where(small, torch.ones_like(squared), squared)
    angle = safe.sqrt()
    first = torch.where(small, 1 - squared / 6 * (1 - squared / 20), torch.sin(angle) / angle)
    second = torch.where(small, 0.5 - squared / 24 * (1 - squared / 30), (1 - torch.cos(angle)) / safe)
    cross = (axis_angle_rad @ _SKEW_SYMMETRIC_BASIS.to(axis_angle_rad)).unflatten(-1, (3, 3))
    return torch.eye(3).to(cross) + first * cross + second * (cross @ cross)


def matrix_to_quaternion(matrix: Float[Tensor, "*n 3 3"]) -> Float[Tensor, "*n 4"]:
    """Convert rotation matrices to quaternions with w >= 0 (Shepperd's method: divide by the largest component)."""
    m = matrix
    trace = m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2]
    four_squares = torch.stack(
        [
            1 + trace,
            1 + 2 * m[..., 0, 0] - trace,
            1 + 2 * m[..., 1, 1] - trace,
            1 + 2 * m[..., 2, 2] - trace,
        ],
        dim=-1,
    )
    wx, wy, wz = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    xy, xz, yz = m[..., 1, 0] + m[..., 0, 1], m[..., 0, 2] + m[..., 2, 0], m[..., 2, 1] + m[..., 1, 2]
    ww, xx, yy, zz = four_squares.unbind(-1)
    candidates = torch.stack(
        [
            torch.stack([ww, wx, wy, wz], dim=-1),
            torch.stack([wx, xx, xy, xz], dim=-1),
            torch.stack([wy, xy, yy, yz], dim=-1),
            torch.stack([wz, xz, yz, zz], dim=-1),
        ],
        dim=-2,
    )
    best = four_squares.argmax(-1)
    chosen = torch.take_along_dim(candidates, best[..., None, None], dim=-2).squeeze(-2)
    chosen = torch.nn.functional.normalize(chosen, dim=-1)
    return torch.where(chosen[..., :1] < 0, -chosen, chosen)


def quaternion_multiply(left_wxyz: Float[Tensor, "*n 4"], right_wxyz: Float[Tensor, "*n 4"]) -> Float[Tensor, "*n 4"]:
    """Return the Hamilton product, the rotation that applies `right_wxyz` first."""
    aw, ax, ay, az = left_wxyz.unbind(-1)
    bw, bx, by, bz = right_wxyz.unbind(-1)
    return torch.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        dim=-1,
    )


def quaternion_conjugate(quaternion_wxyz: Float[Tensor, "*n 4"]) -> Float[Tensor, "*n 4"]:
    """Return the conjugate, which is the inverse rotation of a unit quaternion."""
    return quaternion_wxyz * quaternion_wxyz.new_tensor([1.0, -1.0, -1.0, -1.0])


def slerp(
    start_wxyz: Float[Tensor, "*n 4"], end_wxyz: Float[Tensor, "*n 4"], fraction: Float[Tensor, "*n 1"]
) -> Float[Tensor, "*n 4"]:
    """Interpolate rotations along the shorter arc (spherical linear interpolation); `fraction` is in [0, 1]."""
    step = quaternion_to_axis_angle(quaternion_multiply(quaternion_conjugate(start_wxyz), end_wxyz))
    return quaternion_multiply(start_wxyz, axis_angle_to_quaternion(step * fraction))


def continuous_quaternions(quaternions_wxyz: Float[Tensor, "n *j 4"]) -> Float[Tensor, "n *j 4"]:
    """Return the same rotations over time (axis 0) with signs such that consecutive dot products are not negative."""
    dots = (quaternions_wxyz[1:] * quaternions_wxyz[:-1]).sum(-1, keepdim=True)
    flips = torch.where(dots < 0, -torch.ones_like(dots), torch.ones_like(dots)).cumprod(0)
    return torch.cat([quaternions_wxyz[:1], quaternions_wxyz[1:] * flips], dim=0)


def rotation_between(start: Float[Tensor, "*n 3"], end: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3 3"]:
    """Return the smallest rotation that takes the direction `start` to the direction `end`.

    Both may have any length > 0. For opposite directions the axis is an arbitrary one perpendicular to `start`.
    """
    start, end = torch.nn.functional.normalize(start, dim=-1), torch.nn.functional.normalize(end, dim=-1)
    cross = torch.linalg.cross(start, end)
    sine, cosine = cross.norm(dim=-1, keepdim=True), (start * end).sum(-1, keepdim=True)
    perpendicular = torch.linalg.cross(start, torch.eye(3, dtype=start.dtype)[start.abs().argmin(-1)])
    axis = torch.nn.functional.normalize(torch.where(sine > 1e-7, cross, perpendicular), dim=-1)
    return axis_angle_to_matrix(axis * torch.atan2(sine, cosine))
