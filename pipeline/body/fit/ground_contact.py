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
    FitModel,
    Points,
    PosedSkeleton,
    pose_points,
    pose_rows,
    pose_skeleton,
)
from pipeline.body.fit.root_placement import root_by_place
from pipeline.geometry.camera import Camera

SOLE_JOINTS = ("LeftFoot", "LeftToeBase", "RightFoot", "RightToeBase")
SOLE_LANDMARKS = (29, 31, 30, 32)
"""Joints below which the sole points lie (heels, balls), and the landmarks that tell whether they are seen."""

LOW_M, HIGH_M = 0.03, 0.08
"""A sole lower than the first over the plane may stand, one higher than the second does not."""

SLOW_M_S, FAST_M_S = 0.10, 0.25
"""The same for its speed, over `SPEED_S`."""

SPEED_S = 0.4

TILT_RAD, POINT_M = 0.1, 0.1
"""Deviations for the plane: its tilt against the camera's upright; one sole's height, whose errors repeat in time."""

PLANE_PASSES = 4
LEAST_STANDING = 0.2
"""There is a floor when at least this share of the soles stands, on average over the frames."""

CONTACT_M, CONTACT_CUTOFF = 0.02, 3.0
"""Standard deviation of a standing sole, and where its robust cost levels off, in deviations."""


@dataclass(frozen=True)
class Contact:
    """Where soles belong in the world: along each row of `axes` (the floor's normal, two directions in the floor) at
    `target_m`; weight 0: unused."""

    points: Points
    axes: Float[Tensor, "3 3"]
    target_m: Float[Tensor, "n 4 3"]
    weight: Float[Tensor, "n 4 3"]


def sole_points(model: FitModel) -> Points:
    """Ankles and balls of the feet, brought down to the ground of the rest pose, each carried by its joint."""
    joints = [ACTIVE_JOINTS.index(name) for name in SOLE_JOINTS]
    rest = model.joints[joints].clone()
    rest[:, 1] = model.vertices[:, 1].min()
    weights = torch.zeros(len(joints), len(ACTIVE_JOINTS), dtype=torch.float64)
    weights[torch.arange(len(joints)), joints] = 1.0
    return Points(rest[None], weights[None], rest.new_zeros(1, len(joints), 3, 0))


def floor_contact(
    model: FitModel,
    rotations: Float[Tensor, "n j 3 3"],
    root_m: Float[Tensor, "n 3"],
    confidence: Float[Tensor, "n l"],
    time_s: Float[Tensor, "n"],
) -> Contact | None:
    """The contact term for a body in these poses; None where no floor shows.

    confidence: trust in the landmarks, 0 to 1; feet that are not seen do not stand.
    """
    points = sole_points(model)
    places_m, _ = pose_points(model, pose_skeleton(model, rotations, root_m), points)
    seen = confidence[:, list(SOLE_LANDMARKS)]
    still = _ramp(speed_m_s(places_m, time_s), SLOW_M_S, FAST_M_S)
    lowest = places_m[..., 1].min(1, keepdim=True).values
    standing = seen * _ramp(places_m[..., 1] - lowest, LOW_M, HIGH_M)
    for _ in range(PLANE_PASSES):
        if float(standing.mean()) < LEAST_STANDING:
            return None
        normal, offset_m = fitted_plane(places_m, standing)
        standing = seen * _ramp((places_m @ normal - offset_m).abs(), LOW_M, HIGH_M)
    anchor_m = _anchors(places_m, standing * still)
    axes = _axes(normal)
    target = anchor_m @ axes.T
    target[..., 0] = offset_m
    weight = torch.stack([standing, standing * still, standing * still], dim=-1)
    return Contact(points, axes, target, weight)


def add_contact(
    system: NormalEquations,
    model: FitModel,
    skeleton: PosedSkeleton,
    root_m: Float[Tensor, "n 3"],
    camera: Camera,
    contact: Contact,
) -> None:
    """Add the rows of standing soles to a system without shared numbers."""
    world, arms = pose_points(model, skeleton, contact.points)
    by_place = root_by_place(root_m, camera)
    residual = (world @ contact.axes.T - contact.target_m) / CONTACT_M
    weight = contact.weight * robust_weights(system, residual.square(), CONTACT_CUTOFF, contact.weight)
    for axis, direction in enumerate(contact.axes):
        covector = (direction / CONTACT_M).expand_as(world)
        rows = pose_rows(skeleton, arms, by_place, covector)
        system.add(rows, covector[..., :0], residual[..., axis], weight[..., axis])


def fitted_plane(
    places_m: Float[Tensor, "n 4 3"], weight: Float[Tensor, "n 4"]
) -> tuple[Float[Tensor, "3"], Float[Tensor, ""]]:
    """Unit normal and offset (normal · x = offset) of the plane through weighted points, near the camera's upright."""
    total = weight.sum()
    middle = (weight[..., None] * places_m).sum((0, 1)) / total
    apart = (places_m - middle).reshape(-1, 3)
    weighted = apart * weight.reshape(-1, 1) / POINT_M**2
    across = apart[:, [0, 2]]
    matrix = across.T @ weighted[:, [0, 2]] + torch.eye(2, dtype=apart.dtype) / TILT_RAD**2
    slope = torch.linalg.solve(matrix, weighted[:, [0, 2]].T @ apart[:, 1])
    normal = torch.nn.functional.normalize(torch.stack([-slope[0], torch.ones_like(total), -slope[1]]), dim=0)
    return normal, normal @ middle


def speed_m_s(places_m: Float[Tensor, "n 4 3"], time_s: Float[Tensor, "n"]) -> Float[Tensor, "n 4"]:
    """Speed of points over `SPEED_S` about each frame."""
    times = time_s.numpy()
    before = np.clip(np.searchsorted(times, times - 0.5 * SPEED_S - 1e-6), 0, len(times) - 1)
    after = np.clip(np.searchsorted(times, times + 0.5 * SPEED_S + 1e-6) - 1, 0, len(times) - 1)
    span = (time_s[after] - time_s[before]).clamp(min=1e-3)
    return (places_m[after] - places_m[before]).norm(dim=-1) / span[:, None]


def _anchors(places_m: Float[Tensor, "n 4 3"], weight: Float[Tensor, "n 4"]) -> Float[Tensor, "n 4 3"]:
    """Mean place of each sole over the run of frames in which it stands still; elsewhere its own place."""
    anchors = places_m.clone()
    for sole in range(weight.shape[1]):
        on = (weight[:, sole] > 0).numpy()
        edges = np.flatnonzero(np.diff(np.concatenate([[False], on, [False]]).astype(np.int8)))
        for first, end in edges.reshape(-1, 2):
            share = weight[first:end, sole, None]
            anchors[first:end, sole] = (share * places_m[first:end, sole]).sum(0) / share.sum()
    return anchors


def _axes(normal: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    side = torch.nn.functional.normalize(torch.linalg.cross(normal, normal.new_tensor([0.0, 0.0, 1.0])), dim=0)
    return torch.stack([normal, side, torch.linalg.cross(normal, side)])


def _ramp(value: Float[Tensor, "n 4"], full: float, none: float) -> Float[Tensor, "n 4"]:
    """1 up to `full`, falling to 0 at `none`."""
    return ((none - value) / (none - full)).clamp(0.0, 1.0)
