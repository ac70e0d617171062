"""Points on the posed linear body and their derivatives.

A small rotation delta_j of joint j is applied in the frame of its parent: R_j <- exp(delta_j) R_j. Let x_k be the
position to which joint k alone would carry a point, and w_k its skin weight. Then the rotation of joint j moves the
point by (parent rotation · delta_j) x arm_j with the lever arm arm_j = sum over k = j and its descendants of
w_k (x_k - joint_j). The root moves in perspective coordinates (`pipeline.body.fit.root_placement`).

Positions are float64; derivatives, the largest arrays of the fit, are float32.

Dimensions: n frames, m points, j active joints, p = 3 j + 3 parameters of a frame, s shape parameters.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.body.fit.linear_body import LinearBody
from pipeline.geometry.skinning import forward_kinematics


@dataclass(frozen=True)
class PosedSkeleton:
    """World rotations of the active joints, those of their parents, and world positions (m)."""

    rotation: Float[Tensor, "n j 3 3"]
    parent_rotation: Float[Tensor, "n j 3 3"]
    position_m: Float[Tensor, "n j 3"]

    def select(self, rows: slice) -> "PosedSkeleton":
        """Return the skeletons of some frames."""
        return PosedSkeleton(self.rotation[rows], self.parent_rotation[rows], self.position_m[rows])


def pose_skeleton(
    model: LinearBody, rotations: Float[Tensor, "n j 3 3"], root_m: Float[Tensor, "n 3"]
) -> PosedSkeleton:
    """Return the forward kinematics of the active joints.

    rotations: local rotations; identity is the A-pose. root_m: world position of the root joint.
    """
    joint_to_world = forward_kinematics(rotations, root_m, model.joints_m, model.parents)
    rotation = joint_to_world[..., :3, :3]
    identity = torch.eye(3, dtype=rotation.dtype).expand(len(rotations), 1, 3, 3)
    return PosedSkeleton(
        rotation,
        torch.cat([identity, rotation[:, list(model.parents[1:])]], dim=1),
        joint_to_world[..., :3, 3],
    )


@dataclass(frozen=True)
class SkinnedPoints:
    """Points of the rest body: position (m), skin weights, derivative with respect to the shape.

    The leading axis has length 1 if the points are the same in every frame.
    """

    rest_m: Float[Tensor, "#n m 3"]
    skin_weights: Float[Tensor, "#n m j"]
    shape_jacobian: Float[Tensor, "#n m 3 s"]

    def select(self, rows: slice) -> "SkinnedPoints":
        """Return the points of some frames."""
        return self if len(self.rest_m) == 1 else SkinnedPoints(*(values[rows] for values in vars(self).values()))


@dataclass(frozen=True)
class PosedPoints:
    """Points of the body in world space.

    lever_arms_m: about every joint (module docstring).
    """

    rest: SkinnedPoints
    world_m: Float[Tensor, "n m 3"]
    lever_arms_m: Float[Tensor, "n m j 3"]

    def select(self, rows: slice) -> "PosedPoints":
        """Return the points of some frames."""
        return PosedPoints(self.rest.select(rows), self.world_m[rows], self.lever_arms_m[rows])


@dataclass(frozen=True)
class Contour:
    """Point-to-line constraints in the image: normal · (projection - target) = 0.

    corners, barycentric: points on faces of the body, as vertex indices and barycentric coordinates.
    weight: 0 for padding.
    """

    corners: Int[Tensor, "n m 3"]
    barycentric: Float[Tensor, "n m 3"]
    target_px: Float[Tensor, "n m 2"]
    normal: Float[Tensor, "n m 2"]
    weight: Float[Tensor, "n m"]

    def select(self, rows: slice) -> "Contour":
        """Return the constraints in some frames."""
        return Contour(*(values[rows] for values in vars(self).values()))


def surface_points(
    model: LinearBody, corners: Int[Tensor, "n m 3"], barycentric: Float[Tensor, "n m 3"]
) -> SkinnedPoints:
    """Return points on faces of the rest body.

    corners: vertex indices. The derivative with respect to the shape is approximated by that of the nearest corner.
    """
    share = barycentric[..., None]
    nearest = corners.gather(2, barycentric.argmax(dim=2, keepdim=True)).squeeze(2)
    return SkinnedPoints(
        (model.vertices_m[corners] * share).sum(2),
        (model.skin_weights[corners] * share).sum(2),
        model.vertices_shape_jacobian[nearest],
    )


def pose_points(model: LinearBody, skeleton: PosedSkeleton, points: SkinnedPoints) -> PosedPoints:
    """Return points in world space with their lever arms."""
    offsets = points.rest_m[:, :, None] - model.joints_m
    carried = torch.einsum("njab,nmjb->nmja", skeleton.rotation, offsets.expand(len(skeleton.rotation), -1, -1, -1))
    weighted = points.skin_weights[..., None] * (carried + skeleton.position_m[:, None])
    world = weighted.sum(2)
    below = torch.einsum("jk,nmkc->nmjc", model.is_descendant.float(), weighted.float())
    weight_below = (points.skin_weights @ model.is_descendant.T)[..., None].float()
    return PosedPoints(points, world, below - weight_below * skeleton.position_m[:, None].float())


def pose_jacobian_rows(
    skeleton: PosedSkeleton,
    lever_arms_m: Float[Tensor, "n m j 3"],
    root_jacobian: Float[Tensor, "n 3 3"],
    point_gradient: Float[Tensor, "n m 3"],
) -> Float[Tensor, "n m p"]:
    """Return the derivative of point_gradient · point with respect to the 3 j joint rotations (rad) and the root (3).

    root_jacobian: derivative of the world position of the root with respect to its parameters.
    """
    point_gradient = point_gradient.float()
    torque = torch.linalg.cross(lever_arms_m, point_gradient[:, :, None].expand_as(lever_arms_m))
    rotation_jacobian = torch.einsum("njba,nmjb->nmja", skeleton.parent_rotation.float(), torque)
    return torch.cat([rotation_jacobian.flatten(2), point_gradient @ root_jacobian.float()], dim=2)


def shape_jacobian_rows(
    model: LinearBody, skeleton: PosedSkeleton, points: SkinnedPoints, point_gradient: Float[Tensor, "n m 3"]
) -> Float[Tensor, "n m s"]:
    """Return the derivative of point_gradient · point with respect to the shape, through the surface and the skeleton.

    Columns of `points.shape_jacobian` beyond the shape of the body (landmark offsets) do not move the skeleton.
    """
    joints_shape_jacobian = model.joints_shape_jacobian
    joint_motion = [torch.zeros(len(skeleton.rotation), *joints_shape_jacobian.shape[1:], dtype=torch.float64)]
    for joint, parent in list(enumerate(model.parents))[1:]:
        step = joints_shape_jacobian[joint] - joints_shape_jacobian[parent]
        joint_motion.append(joint_motion[parent] + skeleton.rotation[:, parent] @ step)
    relative_joint_motion = torch.stack(joint_motion, dim=1) - skeleton.rotation @ joints_shape_jacobian
    weighted = (points.skin_weights.float()[..., None] * point_gradient.float()[:, :, None]).flatten(2)  # n, m, 3 j
    # Sums over joints and axes as one matrix product a frame: an array of (n, m, j, s) would be written and read.
    rest_gradient = (weighted @ skeleton.rotation.flatten(1, 2).float()).unbind(-1)
    shape_jacobian = points.shape_jacobian.float()
    rows = rest_gradient[0][..., None] * shape_jacobian[:, :, 0]
    for axis in (1, 2):
        rows.addcmul_(rest_gradient[axis][..., None], shape_jacobian[:, :, axis].expand_as(rows))
    rows[..., : relative_joint_motion.shape[-1]] += weighted @ relative_joint_motion.flatten(1, 2).float()
    return rows
