"""Ground contact: soles that are low and slow lie on one plane and do not move.

An image hardly determines the depth of a foot. On the plane of all standing soles, the image row of a foot does. The
plane is estimated from the current fit, again each time silhouettes are matched. High or fast soles do not contribute,
so jumps and steps stay free.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.body.fit.linear_body import ACTIVE_JOINTS, LinearBody
from pipeline.body.fit.posed_points import SkinnedPoints, pose_points, pose_skeleton
from pipeline.capture.frame_selection import runs_of

SOLE_JOINTS = ("LeftFoot", "LeftToeBase", "RightFoot", "RightToeBase")
SOLE_LANDMARK_INDICES = (29, 31, 30, 32)
"""Joints above the sole points (heels, balls of the feet), and the landmarks whose confidence they get."""

STANDING_HEIGHT_M, RAISED_HEIGHT_M = 0.03, 0.08
"""Heights above the plane up to which a sole stands, and from which it does not."""

STATIONARY_SPEED_M_S, MOVING_SPEED_M_S = 0.10, 0.25
"""Speeds up to which a sole is stationary, and from which it is not, over `SPEED_WINDOW_S`."""

SPEED_WINDOW_S = 0.4

PLANE_TILT_STD_RAD, SOLE_HEIGHT_STD_M = 0.1, 0.1
"""Standard deviations of the tilt of the plane from the y axis of the world, and of the height of a sole, whose errors
are correlated in time."""

FLOOR_TILT_STD_RAD, COMMON_HEIGHT_STD_M = 0.035, 0.05
"""Standard deviations of the tilt of a floor of any extent, and of the height over the root mean square extent of the
soles. More frames do not lower them: who stands with a leaning fit has soles on a leaning plane in all of them."""

PLANE_ITERATIONS = 4
MIN_STANDING_SHARE = 0.2
"""Fraction of standing soles, mean over frames, below which no floor is assumed."""

CONTACT_STD_M, CONTACT_CUTOFF = 0.02, 3.0
"""Standard deviation of the position of a standing sole, and cutoff of its robust cost in standard deviations."""


@dataclass(frozen=True)
class Contact:
    """Positions of standing soles in the world, along each row of `axes`; weight 0: unused.

    axes: normal of the floor and two directions in it. target_m: coordinate along each axis.
    """

    points: SkinnedPoints
    axes: Float[Tensor, "3 3"]
    target_m: Float[Tensor, "n 4 3"]
    weight: Float[Tensor, "n 4 3"]

    def select(self, rows: slice) -> "Contact":
        """Return the contacts in some frames."""
        return Contact(self.points.select(rows), self.axes, self.target_m[rows], self.weight[rows])


def sole_points(model: LinearBody) -> SkinnedPoints:
    """Return heels and balls of the feet at ground level of the rest pose; each point moves with one joint."""
    joints = [ACTIVE_JOINTS.index(name) for name in SOLE_JOINTS]
    rest = model.joints_m[joints].clone()
    rest[:, 1] = model.vertices_m[:, 1].min()
    weights = torch.zeros(len(joints), len(ACTIVE_JOINTS), dtype=torch.float64)
    weights[torch.arange(len(joints)), joints] = 1.0
    return SkinnedPoints(rest[None], weights[None], rest.new_zeros(1, len(joints), 3, 0))


def estimate_floor_contact(
    model: LinearBody,
    rotations: Float[Tensor, "n j 3 3"],
    root_m: Float[Tensor, "n 3"],
    confidence: Float[Tensor, "n l"],
    time_s: Float[Tensor, "n"],
) -> Contact | None:
    """Return the floor contacts of a body in these poses; None if there is no floor.

    confidence: of the landmarks, 0 to 1.
    """
    points = sole_points(model)
    positions_m = pose_points(model, pose_skeleton(model, rotations, root_m), points).world_m
    foot_confidence = confidence[:, list(SOLE_LANDMARK_INDICES)]
    stationary = _linear_falloff(compute_speed_m_s(positions_m, time_s), STATIONARY_SPEED_M_S, MOVING_SPEED_M_S)
    lowest = positions_m[..., 1].min(1, keepdim=True).values
    standing = foot_confidence * _linear_falloff(positions_m[..., 1] - lowest, STANDING_HEIGHT_M, RAISED_HEIGHT_M)
    for _ in range(PLANE_ITERATIONS):
        if float(standing.mean()) < MIN_STANDING_SHARE:
            return None
        normal, offset_m = fit_plane(positions_m, standing)
        standing = foot_confidence * _linear_falloff(
            (positions_m @ normal - offset_m).abs(), STANDING_HEIGHT_M, RAISED_HEIGHT_M
        )
    anchor_m = _anchors(positions_m, standing * stationary)
    axes = _contact_axes(normal)
    target = anchor_m @ axes.T
    target[..., 0] = offset_m
    weight = torch.stack([standing, standing * stationary, standing * stationary], dim=-1)
    return Contact(points, axes, target, weight)


def fit_plane(
    positions_m: Float[Tensor, "n 4 3"], weight: Float[Tensor, "n 4"]
) -> tuple[Float[Tensor, "3"], Float[Tensor, ""]]:
    """Return unit normal and offset (m) of the plane through weighted points: normal · x = offset.

    A prior keeps the normal near the y axis, the estimated vertical (`pipeline.body.fit.vertical.gravity`).
    """
    total = weight.sum()
    centroid = (weight[..., None] * positions_m).sum((0, 1)) / total
    offset = (positions_m - centroid).reshape(-1, 3)
    weighted = offset * weight.reshape(-1, 1) / SOLE_HEIGHT_STD_M**2
    horizontal = offset[:, [0, 2]]
    matrix = horizontal.T @ weighted[:, [0, 2]] + torch.eye(2, dtype=offset.dtype) / PLANE_TILT_STD_RAD**2
    slope = torch.linalg.solve(matrix, weighted[:, [0, 2]].T @ offset[:, 1])
    normal = torch.nn.functional.normalize(torch.stack([-slope[0], torch.ones_like(total), -slope[1]]), dim=0)
    return normal, normal @ centroid


def floor_tilt_information(positions_m: Float[Tensor, "n 4 3"], weight: Float[Tensor, "n 4"]) -> Float[Tensor, "2 2"]:
    """Return the information (1 / rad²) that weighted points of a plane give on its slope along x and z."""
    centroid = (weight[..., None] * positions_m).sum((0, 1)) / weight.sum()
    horizontal = (positions_m - centroid)[..., [0, 2]].reshape(-1, 2)
    scatter = horizontal.T @ (horizontal * weight.reshape(-1, 1)) / weight.sum()
    information = scatter / COMMON_HEIGHT_STD_M**2
    identity = torch.eye(2, dtype=positions_m.dtype)
    return torch.linalg.solve(identity + FLOOR_TILT_STD_RAD**2 * information, information)


def compute_speed_m_s(positions_m: Float[Tensor, "n 4 3"], time_s: Float[Tensor, "n"]) -> Float[Tensor, "n 4"]:
    """Return the speed of points over `SPEED_WINDOW_S` around each frame."""
    times = time_s.numpy()
    before = np.clip(np.searchsorted(times, times - 0.5 * SPEED_WINDOW_S - 1e-6), 0, len(times) - 1)
    after = np.clip(np.searchsorted(times, times + 0.5 * SPEED_WINDOW_S + 1e-6) - 1, 0, len(times) - 1)
    span = (time_s[after] - time_s[before]).clamp(min=1e-3)
    return (positions_m[after] - positions_m[before]).norm(dim=-1) / span[:, None]


def _anchors(positions_m: Float[Tensor, "n 4 3"], weight: Float[Tensor, "n 4"]) -> Float[Tensor, "n 4 3"]:
    """Return the mean position of each sole over the run of frames in which it stands; else its own position."""
    anchors = positions_m.clone()
    for sole in range(weight.shape[1]):
        for first, end in runs_of((weight[:, sole] > 0).numpy()):
            share = weight[first:end, sole, None]
            anchors[first:end, sole] = (share * positions_m[first:end, sole]).sum(0) / share.sum()
    return anchors


def _contact_axes(normal: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """Return normal and two directions in the plane, as rows."""
    side = torch.nn.functional.normalize(torch.linalg.cross(normal, normal.new_tensor([0.0, 0.0, 1.0])), dim=0)
    return torch.stack([normal, side, torch.linalg.cross(normal, side)])


def _linear_falloff(value: Float[Tensor, "n 4"], full: float, none: float) -> Float[Tensor, "n 4"]:
    """Return 1 up to `full`, falling linearly to 0 at `none`."""
    return ((none - value) / (none - full)).clamp(0.0, 1.0)
