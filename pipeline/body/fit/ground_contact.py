"""Floor contact: soles that are low and slow stand on one plane and stay where they are.

A picture tells hardly how far away a foot is, the floor does: on the plane that all standing soles share, a foot's row
in the image fixes its depth. The plane is found from the fit as it stands and found again each round, as outlines are
paired; a sole that is high or fast has no part in it, so that jumps and steps stay free.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.body.fit.levenberg_marquardt import NormalEquations, robust_weights
from pipeline.body.fit.linear_body import (
    ACTIVE_JOINTS,
    LinearBody,
    PosedSkeleton,
    SkinnedPoints,
    pose_jacobian_rows,
    pose_points,
    pose_skeleton,
)
from pipeline.body.fit.root_placement import root_jacobian
from pipeline.geometry.camera import Camera

SOLE_JOINTS = ("LeftFoot", "LeftToeBase", "RightFoot", "RightToeBase")
SOLE_LANDMARK_INDICES = (29, 31, 30, 32)
"""Joints below which the sole points lie (heels, balls), and the landmarks that tell whether they are seen."""

STANDING_HEIGHT_M, RAISED_HEIGHT_M = 0.03, 0.08
"""A sole lower than the first over the plane may stand, one higher than the second does not."""

STATIONARY_SPEED_M_S, MOVING_SPEED_M_S = 0.10, 0.25
"""The same for its speed, over `SPEED_WINDOW_S`."""

SPEED_WINDOW_S = 0.4

PLANE_TILT_STD_RAD, SOLE_HEIGHT_STD_M = 0.1, 0.1
"""Deviations for the plane: its tilt against the camera's upright; one sole's height, whose errors repeat in time."""

PLANE_ITERATIONS = 4
MIN_STANDING_SHARE = 0.2
"""There is a floor when at least this share of the soles stands, on average over the frames."""

CONTACT_STD_M, CONTACT_CUTOFF = 0.02, 3.0
"""Standard deviation of a standing sole, and where its robust cost levels off, in deviations."""


@dataclass(frozen=True)
class Contact:
    """Where soles belong in the world: along each row of `axes` (the floor's normal, two directions in the floor) at
    `target_m`; weight 0: unused."""

    points: SkinnedPoints
    axes: Float[Tensor, "3 3"]
    target_m: Float[Tensor, "n 4 3"]
    weight: Float[Tensor, "n 4 3"]


def sole_points(model: LinearBody) -> SkinnedPoints:
    """Ankles and balls of the feet, brought down to the ground of the rest pose, each carried by its joint."""
    joints = [ACTIVE_JOINTS.index(name) for name in SOLE_JOINTS]
    rest = model.joints[joints].clone()
    rest[:, 1] = model.vertices[:, 1].min()
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
    """The contact term for a body in these poses; None where no floor shows.

    confidence: trust in the landmarks, 0 to 1; feet that are not seen do not stand.
    """
    points = sole_points(model)
    positions_m, _ = pose_points(model, pose_skeleton(model, rotations, root_m), points)
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


def add_contact_term(
    system: NormalEquations,
    model: LinearBody,
    skeleton: PosedSkeleton,
    root_m: Float[Tensor, "n 3"],
    camera: Camera,
    contact: Contact,
) -> None:
    """Add the rows of standing soles to a system without shared numbers."""
    world, lever_arms = pose_points(model, skeleton, contact.points)
    perspective_jacobian = root_jacobian(root_m, camera)
    residual = (world @ contact.axes.T - contact.target_m) / CONTACT_STD_M
    weight = contact.weight * robust_weights(system, residual.square(), CONTACT_CUTOFF, contact.weight)
    for axis, direction in enumerate(contact.axes):
        point_gradient = (direction / CONTACT_STD_M).expand_as(world)
        rows = pose_jacobian_rows(skeleton, lever_arms, perspective_jacobian, point_gradient)
        system.add(rows, point_gradient[..., :0], residual[..., axis], weight[..., axis])


def fit_plane(
    positions_m: Float[Tensor, "n 4 3"], weight: Float[Tensor, "n 4"]
) -> tuple[Float[Tensor, "3"], Float[Tensor, ""]]:
    """Unit normal and offset (normal · x = offset) of the plane through weighted points, near the camera's upright."""
    total = weight.sum()
    middle = (weight[..., None] * positions_m).sum((0, 1)) / total
    apart = (positions_m - middle).reshape(-1, 3)
    weighted = apart * weight.reshape(-1, 1) / SOLE_HEIGHT_STD_M**2
    across = apart[:, [0, 2]]
    matrix = across.T @ weighted[:, [0, 2]] + torch.eye(2, dtype=apart.dtype) / PLANE_TILT_STD_RAD**2
    slope = torch.linalg.solve(matrix, weighted[:, [0, 2]].T @ apart[:, 1])
    normal = torch.nn.functional.normalize(torch.stack([-slope[0], torch.ones_like(total), -slope[1]]), dim=0)
    return normal, normal @ middle


def compute_speed_m_s(positions_m: Float[Tensor, "n 4 3"], time_s: Float[Tensor, "n"]) -> Float[Tensor, "n 4"]:
    """Speed of points over `SPEED_WINDOW_S` about each frame."""
    times = time_s.numpy()
    before = np.clip(np.searchsorted(times, times - 0.5 * SPEED_WINDOW_S - 1e-6), 0, len(times) - 1)
    after = np.clip(np.searchsorted(times, times + 0.5 * SPEED_WINDOW_S + 1e-6) - 1, 0, len(times) - 1)
    span = (time_s[after] - time_s[before]).clamp(min=1e-3)
    return (positions_m[after] - positions_m[before]).norm(dim=-1) / span[:, None]


def _anchors(positions_m: Float[Tensor, "n 4 3"], weight: Float[Tensor, "n 4"]) -> Float[Tensor, "n 4 3"]:
    """Mean place of each sole over the run of frames in which it stands still; elsewhere its own place."""
    anchors = positions_m.clone()
    for sole in range(weight.shape[1]):
        on = (weight[:, sole] > 0).numpy()
        edges = np.flatnonzero(np.diff(np.concatenate([[False], on, [False]]).astype(np.int8)))
        for first, end in edges.reshape(-1, 2):
            share = weight[first:end, sole, None]
            anchors[first:end, sole] = (share * positions_m[first:end, sole]).sum(0) / share.sum()
    return anchors


def _contact_axes(normal: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    side = torch.nn.functional.normalize(torch.linalg.cross(normal, normal.new_tensor([0.0, 0.0, 1.0])), dim=0)
    return torch.stack([normal, side, torch.linalg.cross(normal, side)])


def _linear_falloff(value: Float[Tensor, "n 4"], full: float, none: float) -> Float[Tensor, "n 4"]:
    """1 up to `full`, falling to 0 at `none`."""
    return ((none - value) / (none - full)).clamp(0.0, 1.0)
