"""Rotations in torch, batched over leading axes. Quaternions are unit and ordered w, x, y, z."""

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
"""What x, y and z give to the rows of a vector's cross product matrix."""


def axis_angle_to_quaternion(axis_angle_rad: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 4"]:
    """Exponential map; smooth at zero, where it uses the Taylor series of sin(a/2)/a."""
    squared = (axis_angle_rad**2).sum(-1, keepdim=True)
    small = squared < 1e-8
    angle = torch.where(small, torch.ones_like(squared), squared).sqrt()
    scale = torch.where(small, 0.5 - squared / 48.0, torch.sin(0.5 * angle) / angle)
    w = torch.where(small, 1.0 - squared / 8.0, torch.cos(0.5 * angle))
    return torch.cat([w, axis_angle_rad * scale], dim=-1)


def quaternion_to_axis_angle(quaternion_wxyz: Float[Tensor, "*n 4"]) -> Float[Tensor, "*n 3"]:
    """Logarithm with the angle in [0, pi]; inverse of `axis_angle_to_quaternion`."""
    quaternion = torch.where(quaternion_wxyz[..., :1] < 0, -quaternion_wxyz, quaternion_wxyz)
    w, xyz = quaternion[..., :1], quaternion[..., 1:]
    squared = (xyz**2).sum(-1, keepdim=True)
    small = squared < 1e-10
    sine = torch.where(small, torch.ones_like(squared), squared).sqrt()
    scale = torch.where(small, 2.0 / w.clamp(min=0.5), 2.0 * torch.atan2(sine, w) / sine)
    return xyz * scale


def quaternion_to_matrix(quaternion_wxyz: Float[Tensor, "*n 4"]) -> Float[Tensor, "*n 3 3"]:
    """Rotation matrices; the quaternion is normalised first, so that gradients stay on the sphere."""
    w, x, y, z = torch.nn.functional.normalize(quaternion_wxyz, dim=-1).unbind(-1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], dim=-1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], dim=-1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], dim=-1),
    ]
    return torch.stack(rows, dim=-2)


def axis_angle_to_matrix(axis_angle_rad: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3 3"]:
    """Rodrigues' formula, I + sin(a)/a K + (1 - cos(a))/a² K²; near zero with the Taylor series of both factors."""
    squared = (axis_angle_rad**2).sum(-1)[..., None, None]
    small = squared < 1e-4
    safe = torch.where(small, torch.ones_like(squared), squared)
    angle = safe.sqrt()
    first = torch.where(small, 1 - squared / 6 * (1 - squared / 20), torch.sin(angle) / angle)
    second = torch.where(small, 0.5 - squared / 24 * (1 - squared / 30), (1 - torch.cos(angle)) / safe)
    cross = (axis_angle_rad @ _SKEW_SYMMETRIC_BASIS.to(axis_angle_rad)).unflatten(-1, (3, 3))
    return torch.eye(3).to(cross) + first * cross + second * (cross @ cross)


def matrix_to_quaternion(matrix: Float[Tensor, "*n 3 3"]) -> Float[Tensor, "*n 4"]:
    """Unit quaternions with w >= 0 (Shepperd's method: divide by the largest of the four candidates)."""
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
    """Hamilton product: the rotation that applies `right` first."""
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
    """The inverse rotation of a unit quaternion."""
    return quaternion_wxyz * quaternion_wxyz.new_tensor([1.0, -1.0, -1.0, -1.0])


def slerp(
    start_wxyz: Float[Tensor, "*n 4"], end_wxyz: Float[Tensor, "*n 4"], fraction: Float[Tensor, "*n 1"]
) -> Float[Tensor, "*n 4"]:
    """Spherical interpolation along the shorter arc; `fraction` in [0, 1]."""
    step = quaternion_to_axis_angle(quaternion_multiply(quaternion_conjugate(start_wxyz), end_wxyz))
    return quaternion_multiply(start_wxyz, axis_angle_to_quaternion(step * fraction))


def continuous_quaternions(quaternions_wxyz: Float[Tensor, "n *j 4"]) -> Float[Tensor, "n *j 4"]:
    """The same rotations over time (axis 0) with signs chosen so that neighbours never lie in opposite hemispheres."""
    dots = (quaternions_wxyz[1:] * quaternions_wxyz[:-1]).sum(-1, keepdim=True)
    flips = torch.where(dots < 0, -torch.ones_like(dots), torch.ones_like(dots)).cumprod(0)
    return torch.cat([quaternions_wxyz[:1], quaternions_wxyz[1:] * flips], dim=0)


def six_d_to_matrix(six_d: Float[Tensor, "*n 6"]) -> Float[Tensor, "*n 3 3"]:
    """Continuous 6D representation (Zhou et al. 2019): Gram-Schmidt on the first two columns."""
    first = torch.nn.functional.normalize(six_d[..., :3], dim=-1)
    second = six_d[..., 3:] - (first * six_d[..., 3:]).sum(-1, keepdim=True) * first
    second = torch.nn.functional.normalize(second, dim=-1)
    return torch.stack([first, second, torch.linalg.cross(first, second)], dim=-1)
