"""Forward kinematics and linear blend skinning in PyTorch.

Notation: n frames, j joints, v vertices, k influences. Joints have the identity as rest orientation:
G_j = G_parent · T(joint_j - joint_parent) · R_j, and the skinning matrix is B_j = G_j · T(-joint_j), as in glTF.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.geometry.rotation import matrix_to_quaternion


def rigid_transform(rotation: Float[Tensor, "*n 3 3"], translation: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 4 4"]:
    """Return homogeneous matrices of rotations and translations (m)."""
    top = torch.cat([rotation, translation[..., None]], dim=-1)
    bottom = top.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*top.shape[:-2], 1, 4)
    return torch.cat([top, bottom], dim=-2)


def forward_kinematics(
    rotations: Float[Tensor, "n j 3 3"],
    root_translation_m: Float[Tensor, "n 3"],
    joints_m: Float[Tensor, "j 3"],
    parents: Sequence[int] | Int[np.ndarray, "j"],
) -> Float[Tensor, "n j 4 4"]:
    """Return the pose of every joint in the world.

    Args:
        rotations: local to the parent; identity is the bind pose.
        root_translation_m: world position of joint 0.
        joints_m: bind-pose joint positions, canonical frame.
        parents: index of the parent of each joint, smaller than the index of the joint; -1 for the root, joint 0.

    Raises:
        ValueError: a parent has a larger index than its child.
    """
    ancestor = np.array(parents, dtype=np.int64)
    count, device = len(ancestor), rotations.device
    wrong = np.flatnonzero((ancestor[1:] < 0) | (ancestor[1:] >= np.arange(1, count))) + 1
    if len(wrong):
        raise ValueError(f"joint {wrong[0]} has parent {ancestor[wrong[0]]}; parents must come before their children")
    offset_m = (joints_m[1:] - joints_m[torch.from_numpy(ancestor[1:]).to(device)]).expand(len(rotations), -1, 3)
    local = rigid_transform(rotations, torch.cat([root_translation_m[:, None], offset_m], dim=1))
    # Row `count` is the world, the parent of the root. Each iteration composes the transform of every joint with that
    # of its current ancestor (pointer jumping), so a skeleton of depth 16 takes four iterations.
    world = torch.cat([local, torch.eye(4, dtype=local.dtype, device=device).expand(len(local), 1, 4, 4)], dim=1)
    ancestor = np.append(np.where(ancestor < 0, count, ancestor), count)
    while (ancestor < count).any():
        world = world[:, torch.from_numpy(ancestor).to(device)] @ world
        ancestor = ancestor[ancestor]
    return world[:, :count]


def local_quaternions(world: Float[np.ndarray, "n j 3 3"], parents: Int[np.ndarray, "j"]) -> Float[np.ndarray, "n j 4"]:
    """Return the rotations (wxyz) of joints relative to their parents; of a root (parent -1), relative to the world."""
    local = world.copy()
    for joint, parent in enumerate(parents):
        if parent >= 0:
            local[:, joint] = world[:, parent].transpose(0, 2, 1) @ world[:, joint]
    return matrix_to_quaternion(torch.from_numpy(local)).numpy().astype(np.float32)


def skinning_transforms(
    joint_to_world: Float[Tensor, "n j 4 4"], joints_m: Float[Tensor, "j 3"]
) -> Float[Tensor, "n j 4 4"]:
    """Return B_j, which transforms canonical points that move rigidly with joint j to the world."""
    rotation = joint_to_world[..., :3, :3]
    moved = (rotation @ joints_m[:, :, None]).squeeze(-1)
    return rigid_transform(rotation, joint_to_world[..., :3, 3] - moved)


def linear_blend_skinning(
    vertices: Float[Tensor, "v 3"], weights: Float[Tensor, "v j"], canonical_to_world: Float[Tensor, "n j 4 4"]
) -> Float[Tensor, "n v 3"]:
    """Return the posed vertices x' = (sum_j w_j B_j) x, in m."""
    n_frames, n_joints = canonical_to_world.shape[:2]
    flat = canonical_to_world[:, :, :3].reshape(n_frames, n_joints, 12)
    blended = torch.einsum("vj,njm->nvm", weights, flat).reshape(n_frames, len(vertices), 3, 4)
    return (blended[..., :3] @ vertices[:, :, None]).squeeze(-1) + blended[..., 3]


def inverse_skinning_matrices(
    joint_indices: Int[np.ndarray, "v k"],
    joint_weights: Float[np.ndarray, "v k"],
    transforms: Float[np.ndarray, "j 4 4"],
) -> Float[np.ndarray, "v 4 4"]:
    """Return matrices that move each vertex to where linear blend skinning by the inverse transforms brings it back.

    joint_weights: rows sum to 1. transforms: of the joints' rigid parts, to the pose in which the result is.
    """
    back = np.linalg.inv(transforms.astype(np.float64))
    return np.linalg.inv(np.einsum("vk,vkab->vab", joint_weights.astype(np.float64), back[joint_indices]))


def dense_weights(indices: Int[Tensor, "v k"], weights: Float[Tensor, "v k"], joint_count: int) -> Float[Tensor, "v j"]:
    """Convert sparse influences to one row of weights per vertex."""
    dense = weights.new_zeros(len(weights), joint_count)
    return dense.scatter_add(1, indices.long(), weights)


def top_k_weights(
    weights: Float[np.ndarray, "v j"], k: int = 4
) -> tuple[Int[np.ndarray, "v k"], Float[np.ndarray, "v k"]]:
    """Return the joints and weights of the k largest influences of each vertex, largest first.

    The weights are renormalised to sum 1; influences of weight 0 have joint 0, as glTF requires.
    """
    indices = np.argsort(-weights, axis=1, kind="stable")[:, :k]
    kept = np.take_along_axis(weights, indices, axis=1)
    kept = kept / kept.sum(axis=1, keepdims=True)
    return np.where(kept > 0, indices, 0).astype(np.int32), kept.astype(np.float32)
