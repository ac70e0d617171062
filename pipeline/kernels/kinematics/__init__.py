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
    correction_row: Int[Tensor, "j"]


class FittedPoses(NamedTuple):
    """Local rotations and the root's place as fitted, and the rigid map into each frame's posed space."""

    rotations: Float[Tensor, "k j 3 3"]
    root_m: Float[Tensor, "k 3"]
    world_to_posed: Float[Tensor, "k 4 4"]


class _Kinematics(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, axis_angles: Tensor, root_shift: Tensor, skeleton: Skeleton, fitted: FittedPoses) -> Tensor:
        local, rotations = (np.empty(fitted.rotations.shape) for _ in range(2))
        matrices = torch.empty(*fitted.rotations.shape[:2], 4, 4)
        joints, parents, correction_row = (tensor.numpy() for tensor in skeleton)
        fitted_rotations, root, rigid = (tensor.numpy() for tensor in fitted)
        corrections = axis_angles.detach().numpy(), root_shift.detach().numpy()
        kinematics_cpu.forward(
            *corrections,
            fitted_rotations,
            correction_row,
            root,
            joints,
            parents,
            rigid,
            local,
            rotations,
            matrices.numpy(),
        )
        ctx.save_for_backward(axis_angles)
        ctx.kept = fitted_rotations, correction_row, joints, parents, rigid, local, rotations
        return matrices

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        (axis_angles,) = ctx.saved_tensors
        grad_axis_angles, grad_shift = torch.empty_like(axis_angles), axis_angles.new_empty(len(axis_angles), 3)
        arrays = (gradient.contiguous().numpy(), grad_axis_angles.numpy(), grad_shift.numpy())
        kinematics_cpu.backward(axis_angles.detach().numpy(), *ctx.kept, *arrays)
        return grad_axis_angles, grad_shift, None, None


def skinning_matrices(
    axis_angles_rad: Float[Tensor, "k c 3"], shift_m: Float[Tensor, "k 3"], skeleton: Skeleton, fitted: FittedPoses
) -> Float[Tensor, "k j 4 4"]:
    """Matrices that carry canonical points into the posed space of each frame; differentiable in the corrections.

    float32 on the CPU. A joint turns by its correction (axis times angle) before its fitted rotation; the root moves by
    `shift_m` in the world.
    """
    return _Kinematics.apply(axis_angles_rad.contiguous(), shift_m.contiguous(), skeleton, fitted)
