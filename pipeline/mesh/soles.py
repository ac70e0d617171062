"""Soles that are level in the canonical pose.

A foot is extracted with the error of its joint's tilt, which frames hardly tell: posed, its sole lies on the floor, but
in the A-pose it points up or to the side, and so it does in any other animation. The feet of the finished mesh are
therefore turned about their ankles, and the motion turns them back. By how much is told twice: by the tilt of the sole
of the mesh, and by that of the joint in frames in which the foot stands. What both tell is taken: the smaller angle, if
they tilt to the same side.
"""

from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import ConvexHull
from torch import Tensor

from pipeline.body.body import Body, Motion, canonical_to_world, posed_joints_m
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.rotation import (
    matrix_to_quaternion,
    quaternion_conjugate,
    quaternion_multiply,
    rotation_between,
)
from pipeline.geometry.skinning import linear_blend_skinning

FEET = (("LeftFoot", "LeftToeBase"), ("RightFoot", "RightToeBase"))
"""Ankle and ball of either foot, which turn together."""

MIN_FOOT_WEIGHT = 0.6
"""Skin weight of a foot from which a vertex belongs to it."""

SOLE_DEPTH_M, SOLE_FITS = 0.006, 2
"""Distance from the plane of a sole up to which vertices tell it, and how often it is fitted to them."""

MAX_TILT_RAD = 0.5
"""A face of a foot's hull that is tilted more is no sole."""

STANDING_HEIGHT_M, FLOOR_QUANTILE, MIN_STANDING_SHARE = 0.03, 0.05, 0.3
"""A foot stands where ankle and ball are at most this much higher above the floor than in the canonical pose; the floor
is this quantile of the lower one of both. Feet that stand in fewer of the frames are left as they are."""


@dataclass(frozen=True)
class LevelSoles:
    """Rotations of the feet, left and right, about their ankles in the canonical pose: from the extracted mesh to one
    with level soles; none by default.
    """

    rotations: Float[np.ndarray, "2 3 3"] = field(default_factory=lambda: np.tile(np.eye(3), (2, 1, 1)))

    @classmethod
    def of(cls, mesh: Mesh, weights: Float[Tensor, "v j"], body: Body, motion: Motion) -> "LevelSoles":
        """Return the rotations that level the soles of a canonical mesh with its skin; none for a body without feet.

        motion: frames that the mesh was made from.
        """
        rotations = cls().rotations
        poses = canonical_to_world(body, motion)
        for side, joints in _feet_of(body).items():
            sole = resting_normal(mesh.vertices[(weights[:, joints].sum(dim=1) > MIN_FOOT_WEIGHT).numpy()])
            standing = standing_normal(body, joints, poses)
            if sole is not None and standing is not None:
                agreed = torch.from_numpy(agreed_normal(sole, standing))
                rotations[side] = rotation_between(agreed, torch.tensor([0.0, 1.0, 0.0]).double())
        return cls(rotations)

    def transforms(self, body: Body) -> Float[Tensor, "j 4 4"]:
        """Return what the rotations do to points that move with each joint."""
        transforms = torch.eye(4).repeat(len(body.joint_names), 1, 1)
        for side, joints in _feet_of(body).items():
            rotation = torch.from_numpy(self.rotations[side]).float()
            ankle_m = torch.from_numpy(body.joints_m[joints[0]]).float()
            transforms[joints, :3, :3] = rotation
            transforms[joints, :3, 3] = ankle_m - rotation @ ankle_m
        return transforms

    def turn_mesh(self, mesh: Mesh, weights: Float[Tensor, "v j"], body: Body) -> Mesh:
        """Return the mesh with level soles."""
        vertices = torch.from_numpy(mesh.vertices).float()
        turned = linear_blend_skinning(vertices, weights.float(), self.transforms(body)[None])[0]
        return Mesh(turned.numpy(), mesh.faces)

    def turn_motion_back(self, motion: Motion, body: Body) -> Motion:
        """Return the motion that poses the mesh with level soles as this one posed the extracted mesh."""
        rotations_wxyz = torch.from_numpy(motion.rotations_wxyz).double()
        for side, (ankle, ball) in _feet_of(body).items():
            turned_wxyz = matrix_to_quaternion(torch.from_numpy(self.rotations[side])).expand(len(rotations_wxyz), 4)
            back_wxyz = quaternion_conjugate(turned_wxyz)
            rotations_wxyz[:, ankle] = quaternion_multiply(rotations_wxyz[:, ankle], back_wxyz)
            ball_wxyz = quaternion_multiply(rotations_wxyz[:, ball], back_wxyz)
            rotations_wxyz[:, ball] = quaternion_multiply(turned_wxyz, ball_wxyz)
        return motion.with_pose(rotations_wxyz.numpy(), motion.root_translation_m)


def _feet_of(body: Body) -> dict[int, list[int]]:
    """Return the joints of the feet that a body has: ankle and ball by side, 0 or 1."""
    return {
        side: [body.joint(name) for name in names]
        for side, names in enumerate(FEET)
        if set(names) <= set(body.joint_names)
    }


def standing_normal(body: Body, joints: list[int], poses: Float[Tensor, "n j 4 4"]) -> Float[np.ndarray, "3"] | None:
    """Return the mean direction that is vertical where a foot stands, in its canonical pose; None if it hardly stands.

    joints: ankle and ball of the foot.
    """
    height_m = posed_joints_m(body, poses)[:, joints, 1] - body.joints_m[joints, 1]
    floor_m = np.quantile(height_m.min(axis=1), FLOOR_QUANTILE) if len(height_m) else 0.0
    stands = (height_m < floor_m + STANDING_HEIGHT_M).all(axis=1)
    if not stands.any() or stands.mean() < MIN_STANDING_SHARE:
        return None
    mean = poses[torch.from_numpy(stands), joints[0], 1, :3].double().mean(dim=0)
    return (mean / mean.norm()).numpy()


def agreed_normal(first: Float[np.ndarray, "3"], second: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """Return the normal whose slopes along x and z are the smaller ones of two upward normals; 0 if signs differ."""
    slopes = np.array([normal[[0, 2]] / normal[1] for normal in (first, second)])
    x, z = np.where(slopes.prod(axis=0) > 0.0, np.sign(slopes[0]) * np.abs(slopes).min(axis=0), 0.0)
    return np.array([x, 1.0, z]) / np.linalg.norm([x, 1.0, z])


def resting_normal(points_m: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3"] | None:
    """Return the upward normal of the plane on which a foot would stand; None if it is too small to stand.

    It stands on the face of its convex hull that is below its middle. Vertices near that face tell the plane.
    """
    points_m = points_m.astype(np.float64)
    if len(points_m) < 4 or np.linalg.matrix_rank(points_m - points_m.mean(axis=0), tol=1e-4) < 3:
        return None
    faces = ConvexHull(points_m).equations
    faces = faces[faces[:, 1] < -np.cos(MAX_TILT_RAD)]
    if not len(faces):
        return None
    middle = points_m.mean(axis=0)
    height_m = -(faces[:, [0, 2]] @ middle[[0, 2]] + faces[:, 3]) / faces[:, 1]
    normal, offset_m = -faces[np.argmax(height_m), :3], faces[np.argmax(height_m), 3]
    for _ in range(SOLE_FITS):
        sole_m = points_m[np.abs(points_m @ normal - offset_m) < SOLE_DEPTH_M]
        if len(sole_m) < 3:
            break
        _, _, axes = np.linalg.svd(sole_m - sole_m.mean(axis=0), full_matrices=False)
        normal = axes[2] * np.sign(axes[2, 1])
        offset_m = normal @ sole_m.mean(axis=0)
    return np.asarray(normal)
