"""The avatar's skeleton as other programs know it: names of the joints, directions of their axes, and rest pose.

A clip that is played by name sets local rotations, so what it does depends on the axes of the joints. The axes here are
those of the rigs that clips are made for, in a common T-pose, carried to the A-pose by the rotation from the A-pose to
the T-pose. A clip whose pose is the T-pose therefore moves the avatar into the T-pose, whatever its rest pose is.

Sources: Mixamo's characters (bones along y, fingers bend about x); the mannequin of Unreal Engine 4 (bones along x, the
right side mirrored with all axes negated), of whose local frames Unreal's glTF importer swaps y and z; Unity's
`HumanBodyBones`, and VRM (https://github.com/vrm-c/vrm-specification), whose joints have the axes of the world in the
T-pose.

Notation: j joints, n frames.
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int

from pipeline.avatar.rig_names import RigName, rig_joint_name
from pipeline.avatar.t_pose import t_pose_transforms
from pipeline.body.body import Body, Motion
from pipeline.geometry.rotation import quaternion_to_matrix
from pipeline.geometry.skinning import forward_kinematics, inverse_skinning_matrices, local_quaternions

RestPose = Literal["a", "t"]


class _Axes(NamedTuple):
    """Two axes of a left or central joint in the T-pose: the first exactly, the second as near as it can be."""

    first: str
    first_direction: tuple[float, float, float]
    second: str
    second_direction: tuple[float, float, float]


_OUT, _UP, _DOWN, _FRONT = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0)
_THUMB = (1.0, 0.0, 1.0)
_WORLD = _Axes("y", _UP, "z", _FRONT)
_PARTS = ("torso", "clavicle", "arm", "hand", "thumb", "leg", "foot", "toe")

_MIXAMO_AXES = {
    "torso": _WORLD,
    "clavicle": _Axes("y", (0.98, -0.19, 0.0), "z", _DOWN),
    "arm": _Axes("y", _OUT, "z", _DOWN),
    "hand": _Axes("y", _OUT, "z", _DOWN),
    "thumb": _Axes("y", _THUMB, "z", _DOWN),
    "leg": _Axes("y", _DOWN, "z", _FRONT),
    "foot": _Axes("y", (0.0, -0.545, 0.838), "z", _UP),
    "toe": _Axes("y", _FRONT, "z", _UP),
}
_UNREAL_AXES = {
    "torso": _Axes("x", _UP, "z", _FRONT),
    "clavicle": _Axes("x", (0.88, -0.17, -0.44), "y", _UP),
    "arm": _Axes("x", _OUT, "z", _FRONT),
    "hand": _Axes("x", _OUT, "z", _UP),
    "thumb": _Axes("x", _THUMB, "y", _UP),
    "leg": _Axes("x", _UP, "z", _FRONT),
    "foot": _Axes("x", _UP, "z", _FRONT),
    "toe": _Axes("x", _FRONT, "z", _DOWN),
}
_AXES: dict[RigName, dict[str, _Axes]] = {
    "plain": _MIXAMO_AXES,
    "mixamo": _MIXAMO_AXES,
    "unity": dict.fromkeys(_PARTS, _WORLD),
    "unreal": _UNREAL_AXES,
    "vrm": dict.fromkeys(_PARTS, _WORLD),
}
"""Directions of clavicles and feet are typical ones, not those of the body: these bones differ between characters."""


@dataclass(frozen=True)
class Rig:
    """A skeleton with its rest pose, which is the bind pose of the mesh.

    Attributes:
        body: the A-pose.
        joint_names: in the file.
        root_name: of a joint without weights at the origin, above the hips; None without one.
        axes: orientation of each joint in the A-pose, columns are its axes.
        bind_to_rest: transform of each joint's rigid part from the A-pose to the rest pose.
    """

    body: Body
    joint_names: tuple[str, ...]
    root_name: str | None
    axes: Float[np.ndarray, "j 3 3"]
    bind_to_rest: Float[np.ndarray, "j 4 4"]

    def rest_matrices(self) -> Float[np.ndarray, "j 4 4"]:
        """Return the pose of every joint, with its axes, in the rest pose; the inverse bind matrices invert them."""
        a_pose = np.tile(np.eye(4), (len(self.axes), 1, 1))
        a_pose[:, :3, :3], a_pose[:, :3, 3] = self.axes, self.body.joints_m
        return self.bind_to_rest @ a_pose

    def local_rest_matrices(self) -> Float[np.ndarray, "j 4 4"]:
        """Return the rest pose of every joint relative to its parent; of the hips, relative to the world."""
        world = self.rest_matrices()
        local = world.copy()
        local[1:] = np.linalg.inv(world[self.body.parents[1:]]) @ world[1:]
        return local

    def world_rotations(self, motion: Motion) -> Float[np.ndarray, "n j 3 3"]:
        """Return the rotation of every joint's rigid part from the A-pose to the world."""
        local = quaternion_to_matrix(torch.from_numpy(motion.rotations_wxyz.astype(np.float64)))
        root_m, joints_m = (
            torch.from_numpy(values.astype(np.float64)) for values in (motion.root_translation_m, self.body.joints_m)
        )
        return forward_kinematics(local, root_m, joints_m, self.body.parents)[..., :3, :3].numpy()

    def local_rotations_wxyz(self, motion: Motion) -> Float[np.ndarray, "n j 4"]:
        """Return the rotation of every joint relative to its parent, in the joints' axes; not that of the rest pose."""
        world = self.world_rotations(motion)
        return local_quaternions(world @ self.axes, self.body.parents)

    def rest_positions(
        self,
        positions_m: Float[np.ndarray, "v 3"],
        joint_indices: Int[np.ndarray, "v k"],
        joint_weights: Float[np.ndarray, "v k"],
    ) -> Float[np.ndarray, "v 3"]:
        """Return positions of the A-pose in the rest pose.

        Linear blend skinning of the result into the A-pose gives back the positions exactly.
        """
        matrices = inverse_skinning_matrices(joint_indices, joint_weights, self.bind_to_rest)
        positions = np.einsum("vab,vb->va", matrices[:, :3, :3], positions_m) + matrices[:, :3, 3]
        return positions.astype(np.float32)


def build_rig(body: Body, rig: RigName = "plain", rest_pose: RestPose = "a") -> Rig:
    """Return the skeleton of a body in the names and axes of `rig`, with the hips where they are in the A-pose.

    Args:
        body: joints with Mixamo's names; a joint with another name has the axes of the torso.
        rig: names and axes.
        rest_pose: A-pose or T-pose.
    """
    to_t_pose = t_pose_transforms(body.joint_names, body.parents, body.joints_m)
    t_axes = np.stack([_t_pose_axes(name, rig) for name in body.joint_names])
    return Rig(
        body,
        tuple(rig_joint_name(name, rig) for name in body.joint_names),
        "root" if rig == "unreal" else None,
        to_t_pose[:, :3, :3].transpose(0, 2, 1) @ t_axes,
        to_t_pose if rest_pose == "t" else np.tile(np.eye(4), (len(t_axes), 1, 1)),
    )


def _t_pose_axes(name: str, rig: RigName) -> Float[np.ndarray, "3 3"]:
    """Return the axes (columns) of a joint in the T-pose; `name` is Mixamo's."""
    axes = _AXES[rig][_part(name)]
    mirror = np.array([-1.0 if name.startswith("Right") else 1.0, 1.0, 1.0])
    if rig == "unreal" and name.startswith("Right"):
        mirror = -mirror
    first, second = mirror * axes.first_direction, mirror * axes.second_direction
    first /= np.linalg.norm(first)
    second -= (second @ first) * first
    i, k = "xyz".index(axes.first), "xyz".index(axes.second)
    columns = np.zeros((3, 3))
    columns[:, i], columns[:, k] = first, second / np.linalg.norm(second)
    columns[:, 3 - i - k] = np.cross(columns[:, i], columns[:, k]) * (1.0 if (k - i) % 3 == 1 else -1.0)
    return columns


def _part(name: str) -> str:
    """Return the part of the body, of `_PARTS`, for one of Mixamo's names."""
    bare = name.removeprefix("Left").removeprefix("Right")
    limbs = {"Shoulder": "clavicle", "Arm": "arm", "ForeArm": "arm", "UpLeg": "leg", "Leg": "leg"}
    limbs |= {"Foot": "foot", "ToeBase": "toe"}
    if bare.startswith("HandThumb"):
        return "thumb"
    if bare == name:
        return "torso"
    return "hand" if bare.startswith("Hand") else limbs.get(bare, "torso")
