"""SMPL, SMPL-H and SMPL-X as a `ParametricBody`, from user-supplied arrays.

Loper et al., "SMPL: a skinned multi-person linear model", 2015; Romero et al., "Embodied hands" (SMPL-H), 2017;
Pavlakos et al., "Expressive body capture" (SMPL-X), 2019. Shape (betas), joint regressor and skin weights are used.
Pose blend shapes are not: avatars use plain linear blend skinning, as everywhere in this project.

SMPL rests in a T-pose, the bind pose here is an A-pose. Upper arms and forearms are rotated to the directions of the
built-in body, and straight fingers are bent slightly in the direction of a fist, which defines their flexion axis. The
rotations are the same for all shapes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.body.body import Body, body_at_shape
from pipeline.geometry.rotation import axis_angle_to_matrix, rotation_between
from pipeline.geometry.skinning import forward_kinematics, linear_blend_skinning, skinning_transforms

_BODY_JOINTS = (
    *("Hips", "LeftUpLeg", "RightUpLeg", "Spine", "LeftLeg", "RightLeg", "Spine1", "LeftFoot", "RightFoot", "Spine2"),
    *("LeftToeBase", "RightToeBase", "Neck", "LeftShoulder", "RightShoulder", "Head", "LeftArm", "RightArm"),
    *("LeftForeArm", "RightForeArm", "LeftHand", "RightHand"),
)
_FINGER_JOINTS = tuple(
    f"{side}Hand{finger}{joint}"
    for side in ("Left", "Right")
    for finger in ("Index", "Middle", "Pinky", "Ring", "Thumb")
    for joint in (1, 2, 3)
)
JOINT_NAMES = {
    24: (*_BODY_JOINTS, "LeftHandMiddle1", "RightHandMiddle1"),
    52: (*_BODY_JOINTS, *_FINGER_JOINTS),
    55: (*_BODY_JOINTS, "Jaw", "LeftEye", "RightEye", *_FINGER_JOINTS),
}
"""Mixamo's names for the joints of SMPL, SMPL-H and SMPL-X, by the number of joints, in the order of the models."""

ARM_DIRECTIONS = {"Arm": (0.662, -0.749, 0.024), "ForeArm": (0.515, -0.519, 0.682)}
"""Unit vectors of left upper arm and forearm of the built-in body in the A-pose; mirrored for the right."""

FINGER_BEND_RAD = 0.2

HEAD_LANDMARK_POSITIONS = {
    "nose": (0.0, 0.468, 0.928),
    "eye_inner": (0.198, 0.61, 0.822),
    "eye": (0.297, 0.61, 0.809),
    "eye_outer": (0.419, 0.61, 0.778),
    "ear": (0.639, 0.532, 0.556),
    "mouth": (0.198, 0.319, 0.884),
    "face_eye_outer": (0.502, 0.544, 0.845),
    "face_eye_inner": (0.179, 0.531, 0.867),
    "face_mouth": (0.283, 0.257, 0.898),
    "face_nose": (0.0, 0.398, 0.999),
    "face_bridge": (0.0, 0.557, 0.912),
}
"""Landmarks of the face in the bounding box of the head, as on the built-in body: fraction of the half width to the
left, of the height from below, of the depth from behind. They do not depend on the order of the vertices."""

JOINT_LANDMARK_OFFSETS_M = {
    "shoulder": (("LeftArm", (-0.012, 0.025, 0.002)),),
    "elbow": (("LeftForeArm", (-0.012, 0.015, 0.012)),),
    "wrist": (("LeftHand", (0.0, -0.006, 0.013)),),
    "pinky": (("LeftHandPinky1", (-0.015, 0.012, 0.01)), ("LeftHand", (0.043, -0.065, 0.056))),
    "index": (("LeftHandIndex1", (0.0, -0.013, -0.02)), ("LeftHand", (0.03, -0.059, 0.086))),
    "thumb": (("LeftHandThumb2", (0.03, -0.02, 0.0)), ("LeftHand", (0.007, -0.039, 0.073))),
    "hip": (("LeftUpLeg", (-0.013, -0.024, 0.028)),),
    "knee": (("LeftLeg", (0.004, -0.002, -0.002)),),
    "ankle": (("LeftFoot", (0.001, 0.029, 0.006)),),
    "heel": (("LeftFoot", (0.0, -0.036, -0.038)),),
    "foot_index": (("LeftToeBase", (-0.001, 0.006, 0.036)),),
    "hand_wrist": (("LeftHand", (0.006, -0.006, 0.009)),),
    "hand_thumb": (("LeftHandThumb2", (-0.002, -0.001, 0.008)), ("LeftHand", (-0.024, -0.02, 0.081))),
    "hand_index": (("LeftHandIndex1", (-0.004, 0.002, -0.009)), ("LeftHand", (0.027, -0.044, 0.097))),
    "hand_pinky": (("LeftHandPinky1", (-0.008, 0.004, -0.003)), ("LeftHand", (0.05, -0.072, 0.043))),
}
"""The other landmarks: offset (m) from a joint, as on the built-in body; the first joint that the model has is used."""

HIP_HALF_WIDTH_M = 0.100
"""Distance of the detector's hip landmarks from the sagittal plane, independent of the hip joints of a model."""


@dataclass(frozen=True)
class SmplArrays:
    """Arrays of a model file: T-pose, +Y up, facing +Z, metres; b betas."""

    template_m: Float[np.ndarray, "v 3"]
    shape_directions_m: Float[np.ndarray, "v 3 b"]
    joint_regressor: Float[np.ndarray, "j v"]
    parents: Int[np.ndarray, "j"]
    skin_weights: Float[np.ndarray, "v j"]
    faces: Int[np.ndarray, "f 3"]


class SmplBody:
    """An SMPL-like model as a `ParametricBody`; its shape parameters are the betas (unit Gaussian about 0).

    Raises:
        ValueError: the model does not have 24, 52 or 55 joints, or a parent does not precede its child.
    """

    def __init__(self, arrays: SmplArrays) -> None:
        count = len(arrays.parents)
        if count not in JOINT_NAMES:
            raise ValueError(f"{count} joints; SMPL has 24, SMPL-H 52, SMPL-X 55")
        self.joint_names: tuple[str, ...] = JOINT_NAMES[count]
        self.shape_names: tuple[str, ...] = tuple(f"beta_{i}" for i in range(arrays.shape_directions_m.shape[2]))
        self.shape_defaults: Float[Tensor, "p"] = torch.zeros(len(self.shape_names))
        self.parents: Int[np.ndarray, "j"] = arrays.parents.astype(np.int32)
        self.faces: Int[np.ndarray, "f 3"] = arrays.faces.astype(np.int32)
        weights = arrays.skin_weights / arrays.skin_weights.sum(axis=1, keepdims=True)
        self.skin_weights: Float[np.ndarray, "v j"] = weights.astype(np.float32)
        self._template, self._directions = _float(arrays.template_m), _float(arrays.shape_directions_m)
        self._joints = _float(arrays.joint_regressor @ arrays.template_m)
        self._joint_directions = _float(np.einsum("jv,vcb->jcb", arrays.joint_regressor, arrays.shape_directions_m))
        self._to_a_pose = a_pose_rotations(self.joint_names, self.parents, self._joints)
        self.landmark_positions_m: Mapping[str, tuple[float, float, float]] = self._landmark_positions_m()

    def rest_pose(self, shape: Float[Tensor, "p"]) -> tuple[Float[Tensor, "v 3"], Float[Tensor, "j 3"]]:
        """Return the A-pose vertices and joints of a shape (betas), canonical frame, differentiable."""
        t_pose, t_pose_joints_m = (
            self._template + self._directions @ shape,
            self._joints + self._joint_directions @ shape,
        )
        joint_to_world = forward_kinematics(
            self._to_a_pose[None], t_pose_joints_m[None, 0], t_pose_joints_m, self.parents
        )
        transforms = skinning_transforms(joint_to_world, t_pose_joints_m)
        vertices = linear_blend_skinning(t_pose, torch.from_numpy(self.skin_weights), transforms)[0]
        joints_m = joint_to_world[0, :, :3, 3]
        origin = torch.stack([joints_m[0, 0], vertices[:, 1].min(), joints_m[0, 2]])
        return vertices - origin, joints_m - origin

    def rest_poses(self, shapes: Float[Tensor, "b p"]) -> tuple[Float[Tensor, "b v 3"], Float[Tensor, "b j 3"]]:
        """Return `rest_pose` of several shapes."""
        vertices, joints_m = zip(*map(self.rest_pose, shapes), strict=True)
        return torch.stack(vertices), torch.stack(joints_m)

    def at_shape(self, shape: Float[Tensor, "p"]) -> Body:
        """Return the body of one shape (betas)."""
        return body_at_shape(self, shape)

    def from_smpl_rotations(self, smpl_rotations: Float[Tensor, "n j 3 3"]) -> Float[Tensor, "n j 3 3"]:
        """Convert SMPL's local rotations (identity: T-pose) to those of this project (identity: A-pose).

        With Q_j the world rotation of joint j in the A-pose: R_j = Q_parent · theta_j · Q_j^T.
        """
        zero_root_m = torch.zeros(1, 3)
        bind = forward_kinematics(self._to_a_pose[None], zero_root_m, self._joints, self.parents)[0, :, :3, :3]
        parent_rotation = torch.cat([torch.eye(3)[None], bind[self.parents[1:].tolist()]])
        return parent_rotation @ smpl_rotations @ bind.transpose(-1, -2)

    def accepts_smpl_poses(self, betas: int) -> bool:
        """Return whether poses and this number of betas, fitted with SMPL, are valid here; SMPL-X has other shapes."""
        return "Jaw" not in self.joint_names and len(self.shape_names) == betas

    def convert_smpl_poses(
        self,
        axis_angle: Float[Tensor, "n 24 3"],
        transl_m: Float[Tensor, "n 3"],
        betas: Float[Tensor, "n b"],
        smpl_to_world: Float[Tensor, "n 4 4"],
    ) -> tuple[Float[Tensor, "n k 3 3"], Float[Tensor, "n 3"]]:
        """Convert SMPL poses to local rotations of the first k joints and world positions of the root joint (m).

        SMPL rotates about the pelvis, which it regresses from the shape, then adds `transl_m`. k is 24, or the 22
        joints that the other models share with SMPL.
        """
        shared_joint_count = len(axis_angle[0]) if len(self.joint_names) == len(axis_angle[0]) else len(_BODY_JOINTS)
        local = torch.eye(3).repeat(len(axis_angle), len(self.joint_names), 1, 1)
        local[:, :shared_joint_count] = axis_angle_to_matrix(axis_angle[:, :shared_joint_count])
        rotations = self.from_smpl_rotations(local)[:, :shared_joint_count]
        rotations[:, 0] = smpl_to_world[:, :3, :3] @ rotations[:, 0]
        pelvis_m = self._joints[0] + betas @ self._joint_directions[0].T + transl_m
        return rotations, (smpl_to_world[:, :3, :3] @ pelvis_m[..., None]).squeeze(-1) + smpl_to_world[:, :3, 3]

    def _landmark_positions_m(self) -> dict[str, tuple[float, float, float]]:
        """Return the positions of the left and central landmarks on the body of the default shape, metres."""
        vertices, joints_m = (rest.double().numpy() for rest in self.rest_pose(self.shape_defaults))
        head = vertices[self.skin_weights[:, self.joint_names.index("Head")] > 0.5]
        low, size = head.min(axis=0), np.ptp(head, axis=0)
        positions_m = {
            name: (0.5 * size[0] * left, low[1] + size[1] * up, low[2] + size[2] * forward)
            for name, (left, up, forward) in HEAD_LANDMARK_POSITIONS.items()
        }
        for name, choices in JOINT_LANDMARK_OFFSETS_M.items():
            joint, offset_m = next(choice for choice in choices if choice[0] in self.joint_names)
            x, y, z = joints_m[self.joint_names.index(joint)] + offset_m
            positions_m[name] = (HIP_HALF_WIDTH_M if name == "hip" else x, y, z)
        return {name: (float(x), float(y), float(z)) for name, (x, y, z) in positions_m.items()}


def a_pose_rotations(
    joint_names: Sequence[str], parents: Int[np.ndarray, "j"], t_pose_joints_m: Float[Tensor, "j 3"]
) -> Float[Tensor, "j 3 3"]:
    """Return the local rotations from SMPL's T-pose to the A-pose (module docstring)."""
    local = torch.eye(3).repeat(len(joint_names), 1, 1)
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        mirror, parent_rotation = torch.tensor([sign, 1.0, 1.0]), torch.eye(3)
        for name, child in (("Arm", "ForeArm"), ("ForeArm", "Hand")):
            joint, end = joint_names.index(side + name), joint_names.index(side + child)
            bone = parent_rotation @ (t_pose_joints_m[end] - t_pose_joints_m[joint])
            a_pose = rotation_between(bone, torch.tensor(ARM_DIRECTIONS[name]) * mirror) @ parent_rotation
            local[joint] = parent_rotation.T @ a_pose
            parent_rotation = a_pose
        for joint, name in enumerate(joint_names):
            if name in _FINGER_JOINTS and name.startswith(side) and "Thumb" not in name:
                local[joint] = axis_angle_to_matrix(torch.tensor([0.0, 0.0, -sign * FINGER_BEND_RAD]))
    return local


def _float(array: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))
