"""Forearms that point away from the camera where they point towards it, or the reverse.

One camera sees where a wrist is in the image, not whether it is in front of the elbow or behind it: the mirror image of
a forearm along the view has the same picture. Whoever stands still in a turn tells which is right. The true forearms
point the same way from the chest in all frames, and mirror images of them do not.

Dimensions: n frames, j active joints.
"""

import math
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pipeline.body.fit.linear_body import ACTIVE_JOINTS, LinearBody
from pipeline.body.fit.posed_points import PosedSkeleton, pose_skeleton
from pipeline.body.fit.prior.posture import is_filmed_from_all_sides
from pipeline.body.fit.state import FitState
from pipeline.geometry.camera import Camera
from pipeline.geometry.rotation import axis_angle_to_matrix

CHEST, SIDES = ACTIVE_JOINTS.index("Spine2"), ("Left", "Right")
MIN_SPREAD_RAD, MAX_SPREAD_RATIO = math.radians(25.0), 0.8
"""Angle (root mean square over the frames) about the common direction of forearms that may be mirrored, at least, and
the part of it that is left at most if they are. The fit leads smoothly from frames that are mirrored to frames that are
not, so those between are off by either choice. Of arms that move, mirror images take away a tenth."""
OUTLIER_RAD = math.radians(60.0)
"""Larger angles count as this one: in a few frames the arm may do something else."""
MIN_MIRROR_RAD = math.radians(20.0)
"""A forearm nearly across the view is its own mirror image."""


def unflip_forearms(model: LinearBody, state: FitState, camera: Camera) -> FitState:
    """Return the state with forearms mirrored along the view in the frames where only this makes an arm still.

    Elbows and the picture of the forearms stay where they are; the upper arm turns about itself, so that the elbow
    bends about its hinge. Recordings from one side, and arms that move or that are still as they are, do not change.
    """
    if not is_filmed_from_all_sides(state.rotations):
        return state
    skeleton = pose_skeleton(model, state.rotations, state.root_m)
    rotations = state.rotations.clone()
    for side in SIDES:
        arm, forearm, hand = (ACTIVE_JOINTS.index(f"{side}{part}") for part in ("Arm", "ForeArm", "Hand"))
        elbow_m = skeleton.position_m[:, forearm]
        lower_m = skeleton.position_m[:, hand] - elbow_m
        view = torch.nn.functional.normalize(elbow_m - torch.as_tensor(camera.centre_m()).to(elbow_m), dim=-1)
        mirrored_m = lower_m - 2.0 * (lower_m * view).sum(-1, keepdim=True) * view
        directions = torch.nn.functional.normalize(torch.stack([lower_m, mirrored_m], dim=1), dim=-1)
        flipped = flipped_frames(directions @ skeleton.rotation[:, CHEST])
        upper_m = elbow_m - skeleton.position_m[:, arm]
        of_arm, of_forearm = _mirrored_rotations(skeleton, (arm, forearm), upper_m, lower_m, mirrored_m)
        rotations[flipped, arm], rotations[flipped, forearm] = of_arm[flipped], of_forearm[flipped]
    return replace(state, rotations=rotations)


def flipped_frames(directions: Float[Tensor, "n 2 3"]) -> Bool[Tensor, "n"]:
    """Return in which frames the second of two unit vectors is taken, so that all of them are nearly the same.

    None if the first ones are nearly the same already, or if no choice makes them so.
    """
    before = _angles(directions[:, 0], directions[:, :1]).amin(2).square().mean(1).amin().sqrt()
    angles = _angles(directions.flatten(0, 1), directions)
    nearest = angles[angles.amin(2).square().mean(1).argmin()]
    mirror_rad = torch.arccos((directions[:, 0] * directions[:, 1]).sum(-1).clamp(-1.0, 1.0))
    flipped = (nearest[:, 1] < nearest[:, 0]) & (mirror_rad > MIN_MIRROR_RAD)
    after = torch.where(flipped, nearest[:, 1], nearest[:, 0]).square().mean().sqrt()
    is_clear = before > MIN_SPREAD_RAD and after < MAX_SPREAD_RATIO * before
    return flipped if is_clear else torch.zeros_like(flipped)


def _angles(candidates: Float[Tensor, "c 3"], directions: Float[Tensor, "n m 3"]) -> Float[Tensor, "c n m"]:
    """Return the angle, rad, between each candidate and each direction, at most `OUTLIER_RAD`."""
    cosine = torch.einsum("ca,nma->cnm", candidates, directions)
    return torch.arccos(cosine.clamp(-1.0, 1.0)).clamp(max=OUTLIER_RAD)


def _mirrored_rotations(
    skeleton: PosedSkeleton,
    joints: tuple[int, int],
    upper_m: Float[Tensor, "n 3"],
    lower_m: Float[Tensor, "n 3"],
    mirrored_m: Float[Tensor, "n 3"],
) -> tuple[Float[Tensor, "n 3 3"], Float[Tensor, "n 3 3"]]:
    """Return local rotations of upper arm and forearm (`joints`) that turn `lower_m`, the forearm, to `mirrored_m`."""
    along = torch.nn.functional.normalize(upper_m, dim=-1)
    hinge, mirrored_hinge = (torch.linalg.cross(along, vector) for vector in (lower_m, mirrored_m))
    twist_rad = torch.atan2(
        (along * torch.linalg.cross(hinge, mirrored_hinge)).sum(-1), (hinge * mirrored_hinge).sum(-1)
    )
    bend_rad = _bend_rad(along, mirrored_m) - _bend_rad(along, lower_m)
    twist = axis_angle_to_matrix(twist_rad[:, None] * along)
    bend = axis_angle_to_matrix(bend_rad[:, None] * torch.nn.functional.normalize(mirrored_hinge, dim=-1))
    arm, forearm = joints
    new_arm = twist @ skeleton.rotation[:, arm]
    new_forearm = bend @ twist @ skeleton.rotation[:, forearm]
    return skeleton.parent_rotation[:, arm].mT @ new_arm, new_arm.mT @ new_forearm


def _bend_rad(along: Float[Tensor, "n 3"], lower_m: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    return torch.atan2(torch.linalg.cross(along, lower_m).norm(dim=-1), (along * lower_m).sum(-1))
