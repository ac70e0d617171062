"""Skinning matrices of corrected poses: some hundred small operations in one.

Its plain twin is `pipeline.body.pose_correction.PoseCorrection.canonical_to_world`, carried into the posed spaces.

Letters: k frames, j joints, c joints that are corrected.
"""

from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.kernels.kinematics import cpu as kinematics_cpu


class Skeleton(NamedTuple):
    """Canonical places of the joints, their parents (-1: none; before their children) and rows of corrections (-1)."""

    joints_m: Float[Tensor, "j 3"]
    parents: Int[Tensor, "j"]
    of_joint: Int[Tensor, "j"]


class FittedPoses(NamedTuple):
    """Local rotations and the root's place as fitted, and the rigid map into each frame's posed space."""

    rotations: Float[Tensor, "k j 3 3"]
    root_m: Float[Tensor, "k 3"]
    posed_from_world: Float[Tensor, "k 4 4"]


class _Kinematics(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, turns: Tensor, shift: Tensor, skeleton: Skeleton, fitted: FittedPoses) -> Tensor:
        local, rotations = (np.empty(fitted.rotations.shape) for _ in range(2))
        matrices = torch.empty(*fitted.rotations.shape[:2], 4, 4)
        joints, parents, of_joint = (tensor.numpy() for tensor in skeleton)
        own, root, rigid = (tensor.numpy() for tensor in fitted)
        moved = turns.detach().numpy(), shift.detach().numpy()
        kinematics_cpu.forward(*moved, own, of_joint, root, joints, parents, rigid, local, rotations, matrices.numpy())
        ctx.save_for_backward(turns)
        ctx.kept = own, of_joint, joints, parents, rigid, local, rotations
        return matrices

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        (turns,) = ctx.saved_tensors
        of_turns, of_shift = torch.empty_like(turns), turns.new_empty(len(turns), 3)
        arrays = (gradient.contiguous().numpy(), of_turns.numpy(), of_shift.numpy())
        kinematics_cpu.backward(turns.detach().numpy(), *ctx.kept, *arrays)
        return of_turns, of_shift, None, None


def skinning_matrices(
    turns_rad: Float[Tensor, "k c 3"], shift_m: Float[Tensor, "k 3"], skeleton: Skeleton, fitted: FittedPoses
) -> Float[Tensor, "k j 4 4"]:
    """Matrices that carry canonical points into the posed space of each frame; differentiable in the corrections.

    float32 on the CPU. A joint turns by its correction (axis times angle) before its fitted rotation; the root moves by
    `shift_m` in the world.
    """
    return _Kinematics.apply(turns_rad.contiguous(), shift_m.contiguous(), skeleton, fitted)
