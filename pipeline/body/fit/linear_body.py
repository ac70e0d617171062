"""Linear approximation of a parametric body around one shape, with 22 active joints and fixed fingers.

Dimensions: v vertices, j active joints, full: all joints of the body, s shape parameters.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.body.body import Body, ParametricBody
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
"""Flexion of each finger joint of a relaxed hand, relative to the A-pose."""

SHAPE_DIFFERENCE_STEP = 0.01
"""Finite-difference step, in units of a phenotype. Phenotypes are piecewise linear, so its size hardly matters."""


@dataclass(frozen=True)
class LinearBody:
    """Rest body at a shape and its derivative; float64, canonical A-pose, metres.

    is_descendant: entry (j, k) is 1 if joint k is joint j or one of its descendants.
    finger_rotations: local rotations of the fingers, which are not active and follow the hand.
    full_joint_indices: index of every active joint among all joints of the body.
    landmark_positions_m: as in `pipeline.body.body.ParametricBody`.
    """

    shape: Float[Tensor, "s"]
    vertices_m: Float[Tensor, "v 3"]
    vertices_shape_jacobian: Float[Tensor, "v 3 s"]
    joints_m: Float[Tensor, "j 3"]
    joints_shape_jacobian: Float[Tensor, "j 3 s"]
    skin_weights: Float[Tensor, "v j"]
    parents: tuple[int, ...]
    is_descendant: Float[Tensor, "j j"]
    faces: Int[Tensor, "f 3"]
    finger_rotations: Float[Tensor, "full 3 3"]
    full_joint_indices: tuple[int, ...]
    joint_index_by_name: dict[str, int]
    full_joints_m: Float[Tensor, "full 3"]
    full_joints_shape_jacobian: Float[Tensor, "full 3 s"]
    landmark_positions_m: Mapping[str, tuple[float, float, float]]

    def at_shape(self, shape: Float[Tensor, "s"]) -> "LinearBody":
        """Return the linear model at another shape; the derivative stays the same."""
        step = shape - self.shape
        return replace(
            self,
            shape=shape,
            vertices_m=self.vertices_m + self.vertices_shape_jacobian @ step,
            joints_m=self.joints_m + self.joints_shape_jacobian @ step,
            full_joints_m=self.full_joints_m + self.full_joints_shape_jacobian @ step,
        )

    def skin_weight_of(self, names: Sequence[str]) -> Float[Tensor, "v"]:
        """Return the summed skin weight of some active joints at each vertex."""
        return self.skin_weights[:, [ACTIVE_JOINTS.index(name) for name in names]].sum(1)

    def all_joint_rotations(self, rotations: Float[Tensor, "n j 3 3"]) -> Float[Tensor, "n full 3 3"]:
        """Return the local rotations of all joints: those of the active joints and the fixed ones of the fingers."""
        all_rotations = self.finger_rotations.repeat(len(rotations), 1, 1, 1)
        all_rotations[:, list(self.full_joint_indices)] = rotations
        return all_rotations

    def height_m(self) -> tuple[float, Float[Tensor, "s"]]:
        """Return the stature of the rest body (m) and its derivative with respect to the shape."""
        top, bottom = int(self.vertices_m[:, 1].argmax()), int(self.vertices_m[:, 1].argmin())
        gradient = self.vertices_shape_jacobian[top, 1] - self.vertices_shape_jacobian[bottom, 1]
        return float(self.vertices_m[top, 1] - self.vertices_m[bottom, 1]), gradient

    def foot_length_m(self) -> tuple[float, Float[Tensor, "s"]]:
        """Return the length of the left foot of the rest body (m) and its derivative with respect to the shape."""
        on_foot = torch.nonzero(self.skin_weight_of(("LeftFoot", "LeftToeBase")) > 0.5).squeeze(1)
        ankle_m, toes_m = (self.joints_m[ACTIVE_JOINTS.index(name)] for name in ("LeftFoot", "LeftToeBase"))
        forward = torch.nn.functional.normalize((toes_m - ankle_m) * toes_m.new_tensor([1.0, 0.0, 1.0]), dim=0)
        place_m = self.vertices_m[on_foot] @ forward
        tip, heel = int(on_foot[place_m.argmax()]), int(on_foot[place_m.argmin()])
        gradient = forward @ (self.vertices_shape_jacobian[tip] - self.vertices_shape_jacobian[heel])
        return float(place_m.max() - place_m.min()), gradient


def linearise_body(
    body: ParametricBody, shape: Float[Tensor, "s"], curls_rad: Float[np.ndarray, "2 4"] | None = None
) -> LinearBody:
    """Linearise the body around a shape by forward differences (backward at the upper end of the range of a phenotype).

    curls_rad: as in `finger_curl_rotations`; None: `relaxed_curls_rad`.
    """
    active = tuple(body.joint_names.index(name) for name in ACTIVE_JOINTS)
    parents = reduced_parents(body.parents, active)
    finger_rotations = finger_curl_rotations(body, relaxed_curls_rad() if curls_rad is None else curls_rad)
    step = torch.where(shape + SHAPE_DIFFERENCE_STEP > 1.0, -SHAPE_DIFFERENCE_STEP, SHAPE_DIFFERENCE_STEP)
    all_vertices, all_joints = _rest_with_finger_curl(
        body, torch.cat([shape[None], shape + torch.diag(step)]), finger_rotations
    )
    vertices, joints = all_vertices[0], all_joints[0]
    vertices_shape_jacobian, joints_shape_jacobian = (
        ((moved[1:] - moved[0]) / step[:, None, None]).permute(1, 2, 0).contiguous()
        for moved in (all_vertices, all_joints)
    )
    return LinearBody(
        shape=shape.double(),
        vertices_m=vertices,
        vertices_shape_jacobian=vertices_shape_jacobian,
        joints_m=joints[list(active)],
        joints_shape_jacobian=joints_shape_jacobian[list(active)],
        skin_weights=merge_skin_weights(body, active),
        parents=parents,
        is_descendant=descendant_matrix(parents),
        faces=torch.as_tensor(body.faces),
        finger_rotations=finger_rotations,
        full_joint_indices=active,
        joint_index_by_name={name: index for index, name in enumerate(body.joint_names)},
        full_joints_m=joints,
        full_joints_shape_jacobian=joints_shape_jacobian,
        landmark_positions_m=body.landmark_positions_m,
    )


def reduced_parents(parents: Sequence[int] | np.ndarray, active: Sequence[int]) -> tuple[int, ...]:
    """Return the nearest active ancestor of every active joint as an index among them; -1 for the root."""
    active_index = {joint: index for index, joint in enumerate(active)}
    reduced = []
    for joint in active:
        parent = int(parents[joint])
        while parent >= 0 and parent not in active_index:
            parent = int(parents[parent])
        reduced.append(active_index.get(parent, -1))
    return tuple(reduced)


def descendant_matrix(parents: Sequence[int]) -> Float[Tensor, "j j"]:
    """Return a matrix whose entry (j, k) is 1 if k is j or a descendant of j."""
    is_descendant = torch.eye(len(parents), dtype=torch.float64)
    for joint, parent in enumerate(parents):
        if parent >= 0:
            is_descendant[:, joint] += is_descendant[:, parent]
    return is_descendant


def merge_skin_weights(body: ParametricBody | Body, active: Sequence[int]) -> Float[Tensor, "v j"]:
    """Return skin weights of the active joints; the weights of other joints go to the nearest active ancestor."""
    active_index = {joint: index for index, joint in enumerate(active)}
    merged = torch.zeros(len(body.skin_weights), len(active), dtype=torch.float64)
    for joint in range(len(body.joint_names)):
        ancestor = joint
        while ancestor not in active_index:
            ancestor = int(body.parents[ancestor])
        merged[:, active_index[ancestor]] += torch.as_tensor(body.skin_weights[:, joint], dtype=torch.float64)
    return merged


def relaxed_curls_rad() -> Float[np.ndarray, "2 4"]:
    """Return the flexion of relaxed finger joints relative to the A-pose (rad), left and right `FINGERS`."""
    return np.full((2, len(FINGERS)), RELAXED_CURL_RAD)


def finger_curl_rotations(body: ParametricBody, curls_rad: Float[np.ndarray, "2 4"]) -> Float[Tensor, "full 3 3"]:
    """Return local rotations of all joints that bend the joints of each finger by its curl.

    The axis is that about which the middle finger is bent in the rest pose. A body without fingers (SMPL) keeps its
    hands.

    curls_rad: for left and right `FINGERS`, relative to the A-pose.
    """
    _, joints = body.rest_pose(body.shape_defaults)
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
    body: ParametricBody, shapes: Float[Tensor, "b s"], finger_rotations: Float[Tensor, "full 3 3"]
) -> tuple[Float[Tensor, "b v 3"], Float[Tensor, "b full 3"]]:
    """Return the rest vertices of several shapes with bent fingers, and the rest positions of all joints (m)."""
    with torch.no_grad():
        vertices, joints = body.rest_poses(shapes.float())
    weights, local = torch.as_tensor(body.skin_weights), finger_rotations.float()[None]
    is_bent = (local[0] != torch.eye(3)).flatten(1).any(1)
    on_fingers = torch.nonzero((weights[:, is_bent] > 0.0).any(1)).squeeze(1)  # the other vertices stay
    positions = torch.empty_like(joints)
    for row, joints_m in enumerate(joints):
        joint_to_world = forward_kinematics(local, joints_m[None, 0], joints_m, body.parents)
        transforms = skinning_transforms(joint_to_world, joints_m)
        fingers = linear_blend_skinning(vertices[row, on_fingers], weights[on_fingers], transforms)
        vertices[row, on_fingers], positions[row] = fingers[0], joint_to_world[0, :, :3, 3]
    return vertices.double(), positions.double()
