"""The parametric body reduced to what a fit moves: 22 joints, a relaxed grip, a shape that is linear around a point.

Letters: n frames, m points, j active joints, p rotation + translation numbers of a frame (3 j + 3), s shape numbers.
A small rotation is applied in the parent's frame: R_j <- exp(delta_j) R_j; the root moves in the coordinates of
`fit_place`. With x_k the place that joint k alone would carry a point to and w_k its skin weight, turning joint j moves
the point by (parent rotation · delta_j) x arm_j, where arm_j = sum over k at or below j of w_k (x_k - joint_j).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.body.body import ParametricBody
from pipeline.geometry.rotation import axis_angle_to_matrix
from pipeline.geometry.skinning import forward_kinematics, linear_blend_skinning, skinning_transforms

ACTIVE_JOINTS = (
    "Hips",
    *("LeftUpLeg", "LeftLeg", "LeftFoot", "LeftToeBase", "RightUpLeg", "RightLeg", "RightFoot", "RightToeBase"),
    *("Spine", "Spine1", "Spine2", "LeftShoulder", "LeftArm", "LeftForeArm", "LeftHand", "Neck", "Head"),
    *("RightShoulder", "RightArm", "RightForeArm", "RightHand"),
)
FINGERS = ("Index", "Middle", "Ring", "Pinky")
RELAXED_CURL_RAD = 0.25
"""How far each finger joint is bent in a hand at rest, beyond the A-pose."""

SHAPE_DIFFERENCE_STEP = 0.01
"""Finite-difference step, in units of a phenotype; phenotypes are piecewise linear, so a larger one buys nothing."""


@dataclass(frozen=True)
class LinearBody:
    """Rest body of shape `shape` and its derivative; float64, canonical A-pose, metres.

    `is_descendant[j, k]` is 1 when joint k is joint j or hangs below it. Fingers are bent by `finger_rotations` and
    move with the hand.
    """

    shape: Float[Tensor, "s"]
    vertices: Float[Tensor, "v 3"]
    vertices_shape_jacobian: Float[Tensor, "v 3 s"]
    joints: Float[Tensor, "j 3"]
    joints_shape_jacobian: Float[Tensor, "j 3 s"]
    weights: Float[Tensor, "v j"]
    parents: tuple[int, ...]
    is_descendant: Float[Tensor, "j j"]
    faces: Int[Tensor, "f 3"]
    finger_rotations: Float[Tensor, "full 3 3"]
    full_joint_indices: tuple[int, ...]
    joint_index_by_name: dict[str, int]
    full_joints: Float[Tensor, "full 3"]
    full_joints_shape_jacobian: Float[Tensor, "full 3 s"]
    landmark_positions_m: Mapping[str, tuple[float, float, float]]

    def moved(self, shape: Float[Tensor, "s"]) -> "LinearBody":
        """The same linear model at another shape (values move along the derivative, which stays)."""
        step = shape - self.shape
        return replace(
            self,
            shape=shape,
            vertices=self.vertices + self.vertices_shape_jacobian @ step,
            joints=self.joints + self.joints_shape_jacobian @ step,
            full_joints=self.full_joints + self.full_joints_shape_jacobian @ step,
        )

    def all_joint_rotations(self, rotations: Float[Tensor, "n j 3 3"]) -> Float[Tensor, "n full 3 3"]:
        """Local rotations of every joint of the body: those of the active ones, and the grip's."""
        all_rotations = self.finger_rotations.repeat(len(rotations), 1, 1, 1)
        all_rotations[:, list(self.full_joint_indices)] = rotations
        return all_rotations

    def height_m(self) -> tuple[float, Float[Tensor, "s"]]:
        """Stature of the rest body and its derivative by shape."""
        top, bottom = int(self.vertices[:, 1].argmax()), int(self.vertices[:, 1].argmin())
        gradient = self.vertices_shape_jacobian[top, 1] - self.vertices_shape_jacobian[bottom, 1]
        return float(self.vertices[top, 1] - self.vertices[bottom, 1]), gradient


def linearise_body(
    body: ParametricBody, shape: Float[Tensor, "s"], curls_rad: Float[np.ndarray, "2 4"] | None = None
) -> LinearBody:
    """The model around a shape, by forward differences (backward at the upper end of a phenotype's range).

    curls_rad: as in `finger_curl_rotations`; None: a relaxed grip.
    """
    active = tuple(body.joint_names.index(name) for name in ACTIVE_JOINTS)
    parents = reduced_parents(body.parents, active)
    finger_rotations = finger_curl_rotations(body, relaxed_curls_rad() if curls_rad is None else curls_rad)
    vertices, joints = _rest_with_finger_curl(body, shape, finger_rotations)
    vertex_columns, joint_columns = [], []
    for index, value in enumerate(shape.tolist()):
        step = -SHAPE_DIFFERENCE_STEP if value + SHAPE_DIFFERENCE_STEP > 1.0 else SHAPE_DIFFERENCE_STEP
        perturbed_shape = shape.clone()
        perturbed_shape[index] += step
        moved_vertices, moved_joints = _rest_with_finger_curl(body, perturbed_shape, finger_rotations)
        vertex_columns.append((moved_vertices - vertices) / step)
        joint_columns.append((moved_joints - joints) / step)
    joints_shape_jacobian = torch.stack(joint_columns, dim=-1)
    return LinearBody(
        shape=shape.double(),
        vertices=vertices,
        vertices_shape_jacobian=torch.stack(vertex_columns, dim=-1),
        joints=joints[list(active)],
        joints_shape_jacobian=joints_shape_jacobian[list(active)],
        weights=merge_skin_weights(body, active),
        parents=parents,
        is_descendant=descendant_matrix(parents),
        faces=torch.as_tensor(body.faces),
        finger_rotations=finger_rotations,
        full_joint_indices=active,
        joint_index_by_name={name: index for index, name in enumerate(body.joint_names)},
        full_joints=joints,
        full_joints_shape_jacobian=joints_shape_jacobian,
        landmark_positions_m=body.landmark_positions_m,
    )


def reduced_parents(parents: Sequence[int] | np.ndarray, active: Sequence[int]) -> tuple[int, ...]:
    """Parents among the active joints: the nearest active ancestor, -1 for the root."""
    place = {joint: index for index, joint in enumerate(active)}
    reduced = []
    for joint in active:
        parent = int(parents[joint])
        while parent >= 0 and parent not in place:
            parent = int(parents[parent])
        reduced.append(place.get(parent, -1))
    return tuple(reduced)


def descendant_matrix(parents: Sequence[int]) -> Float[Tensor, "j j"]:
    """Entry (j, k) is 1 when k is j or a descendant of j."""
    is_descendant = torch.eye(len(parents), dtype=torch.float64)
    for joint, parent in enumerate(parents):
        if parent >= 0:
            is_descendant[:, joint] += is_descendant[:, parent]
    return is_descendant


def merge_skin_weights(body: ParametricBody, active: Sequence[int]) -> Float[Tensor, "v j"]:
    """Skin weights with those of inactive joints (fingers) given to their nearest active ancestor."""
    place = {joint: index for index, joint in enumerate(active)}
    folded = torch.zeros(len(body.skin_weights), len(active), dtype=torch.float64)
    for joint in range(len(body.joint_names)):
        ancestor = joint
        while ancestor not in place:
            ancestor = int(body.parents[ancestor])
        folded[:, place[ancestor]] += torch.as_tensor(body.skin_weights[:, joint], dtype=torch.float64)
    return folded


def relaxed_curls_rad() -> Float[np.ndarray, "2 4"]:
    """Bend of every finger joint beyond the A-pose in a hand at rest (rad), for left and right `FINGERS`."""
    return np.full((2, len(FINGERS)), RELAXED_CURL_RAD)


def finger_curl_rotations(body: ParametricBody, curls_rad: Float[np.ndarray, "2 4"]) -> Float[Tensor, "full 3 3"]:
    """Local rotations of all joints in which each finger's joints are bent by its curl and the rest is the A-pose.

    Fingers bend further the way in which the middle finger of the rest pose is bent already; a body without fingers
    (SMPL) keeps its hands.
    """
    _, joints = body.rest(body.shape_defaults)
    axis_angle = torch.zeros(len(body.joint_names), 3, dtype=torch.float64)
    for side, curls in zip(("Left", "Right"), curls_rad.tolist(), strict=True):
        if f"{side}HandMiddle3" not in body.joint_names:
            continue
        hand, knuckle, tip = (
            joints[body.joint_names.index(f"{side}Hand{part}")].double() for part in ("", "Middle1", "Middle3")
        )
        bend = torch.nn.functional.normalize(torch.linalg.cross(knuckle - hand, tip - knuckle), dim=0)
        for finger, curl in zip(FINGERS, curls, strict=True):
            for bone in (1, 2, 3):
                axis_angle[body.joint_names.index(f"{side}Hand{finger}{bone}")] = bend * curl
    return axis_angle_to_matrix(axis_angle)


def _rest_with_finger_curl(
    body: ParametricBody, shape: Float[Tensor, "s"], finger_rotations: Float[Tensor, "full 3 3"]
) -> tuple[Float[Tensor, "v 3"], Float[Tensor, "full 3"]]:
    """Rest vertices with the fingers bent, and all rest joints."""
    with torch.no_grad():
        vertices, joints = body.rest(shape.float())
    joint_to_world = forward_kinematics(finger_rotations.float()[None], joints[None, 0], joints, body.parents)
    bent = linear_blend_skinning(
        vertices, torch.as_tensor(body.skin_weights), skinning_transforms(joint_to_world, joints)
    )
    return bent[0].double(), joint_to_world[0, :, :3, 3].double()


@dataclass(frozen=True)
class PosedSkeleton:
    """Where the active joints are: rotations to the world, those of their parents, and positions (m)."""

    rotation: Float[Tensor, "n j 3 3"]
    parent_rotation: Float[Tensor, "n j 3 3"]
    position: Float[Tensor, "n j 3"]


def pose_skeleton(
    model: LinearBody, rotations: Float[Tensor, "n j 3 3"], root_m: Float[Tensor, "n 3"]
) -> PosedSkeleton:
    """Forward kinematics of the active joints (`skinning.forward_kinematics`)."""
    joint_to_world = forward_kinematics(rotations, root_m, model.joints, model.parents)
    rotation = joint_to_world[..., :3, :3]
    identity = torch.eye(3, dtype=rotation.dtype).expand(len(rotations), 1, 3, 3)
    return PosedSkeleton(
        rotation,
        torch.cat([identity, rotation[:, list(model.parents[1:])]], dim=1),
        joint_to_world[..., :3, 3],
    )


@dataclass(frozen=True)
class SkinnedPoints:
    """Points of the rest body: position, skin weights, derivative by shape. The leading axis is 1 or one a frame."""

    rest: Float[Tensor, "#n m 3"]
    weights: Float[Tensor, "#n m j"]
    shape_jacobian: Float[Tensor, "#n m 3 s"]


def surface_points(
    model: LinearBody, corners: Int[Tensor, "n m 3"], barycentric: Float[Tensor, "n m 3"]
) -> SkinnedPoints:
    """Points on the body's faces; `corners` are vertices. The shape's derivative is that of the nearest corner."""
    share = barycentric[..., None]
    nearest = corners.gather(2, barycentric.argmax(dim=2, keepdim=True)).squeeze(2)
    return SkinnedPoints(
        (model.vertices[corners] * share).sum(2),
        (model.weights[corners] * share).sum(2),
        model.vertices_shape_jacobian[nearest],
    )


def pose_points(
    model: LinearBody, skeleton: PosedSkeleton, points: SkinnedPoints
) -> tuple[Float[Tensor, "n m 3"], Float[Tensor, "n m j 3"]]:
    """World positions (m) of points, and their lever arms about every joint (module docstring)."""
    offsets = points.rest[:, :, None] - model.joints
    carried = torch.einsum("njab,nmjb->nmja", skeleton.rotation, offsets.expand(len(skeleton.rotation), -1, -1, -1))
    weighted = points.weights[..., None] * (carried + skeleton.position[:, None])
    world = weighted.sum(2)
    below = torch.einsum("jk,nmkc->nmjc", model.is_descendant, weighted)
    weight_below = (points.weights @ model.is_descendant.T)[..., None]
    return world, below - weight_below * skeleton.position[:, None]


def pose_jacobian_rows(
    skeleton: PosedSkeleton,
    lever_arms: Float[Tensor, "n m j 3"],
    root_jacobian: Float[Tensor, "n 3 3"],
    point_gradient: Float[Tensor, "n m 3"],
) -> Float[Tensor, "n m p"]:
    """Derivative of covector · point by the frame's joint rotations (3 j numbers) and the root's place (3)."""
    torque = torch.linalg.cross(lever_arms, point_gradient[:, :, None].expand_as(lever_arms))
    rotation_jacobian = torch.einsum("njba,nmjb->nmja", skeleton.parent_rotation, torque)
    return torch.cat([rotation_jacobian.flatten(2), point_gradient @ root_jacobian], dim=2)


def shape_jacobian_rows(
    model: LinearBody, skeleton: PosedSkeleton, points: SkinnedPoints, point_gradient: Float[Tensor, "n m 3"]
) -> Float[Tensor, "n m s"]:
    """Derivative of covector · point by the shape, through the surface and through the skeleton.

    Columns of `points.shape_jacobian` beyond the body's shape (landmark offsets) do not move the skeleton.
    """
    joints_shape_jacobian = model.joints_shape_jacobian
    moved = [torch.zeros(len(skeleton.rotation), *joints_shape_jacobian.shape[1:], dtype=torch.float64)]
    for joint, parent in list(enumerate(model.parents))[1:]:
        step = joints_shape_jacobian[joint] - joints_shape_jacobian[parent]
        moved.append(moved[parent] + skeleton.rotation[:, parent] @ step)
    relative_joint_motion = torch.stack(moved, dim=1) - skeleton.rotation @ joints_shape_jacobian
    turned = torch.einsum(
        "nmj,njab,nma->nmb", points.weights.expand(*point_gradient.shape[:2], -1), skeleton.rotation, point_gradient
    )
    rows = (turned[..., None] * points.shape_jacobian).sum(2)
    skeleton_gradient = torch.einsum("nma,njas->nmjs", point_gradient, relative_joint_motion)
    rows[..., : relative_joint_motion.shape[-1]] += (points.weights[..., None] * skeleton_gradient).sum(2)
    return rows
