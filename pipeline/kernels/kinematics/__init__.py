"""Skinning matrices of corrected poses: forward kinematics as one operation instead of about a hundred small ones.

Notation: k frames, j joints, c corrected joints.
"""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.kernels.common.dispatch import runs_on_numba
from pipeline.kernels.kinematics import cpu, reference
from pipeline.kernels.kinematics.cpu import PoseArrays, SkeletonArrays
from pipeline.kernels.kinematics.inputs import FittedPoses, Skeleton

__all__ = ["FittedPoses", "Skeleton", "skinning_matrices"]


class _Kinematics(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, axis_angles: Tensor, root_shift: Tensor, skeleton: Skeleton, fitted: FittedPoses) -> Tensor:
        local, rotations = (np.empty(fitted.rotations.shape) for _ in range(2))
        matrices = torch.empty(*fitted.rotations.shape[:2], 4, 4)
        skeleton_arrays = SkeletonArrays(*(tensor.numpy() for tensor in skeleton))
        poses = PoseArrays(*(tensor.numpy() for tensor in fitted))
        corrections = axis_angles.detach().numpy(), root_shift.detach().numpy()
        cpu.forward(*corrections, skeleton_arrays, poses, local, rotations, matrices.numpy())
        ctx.save_for_backward(axis_angles)
        ctx.kept = skeleton_arrays, poses, local, rotations
        return matrices

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        (axis_angles,) = ctx.saved_tensors
        grad_axis_angles, grad_shift = torch.empty_like(axis_angles), axis_angles.new_empty(len(axis_angles), 3)
        arrays = (gradient.contiguous().numpy(), grad_axis_angles.numpy(), grad_shift.numpy())
        cpu.backward(axis_angles.detach().numpy(), *ctx.kept, *arrays)
        return grad_axis_angles, grad_shift, None, None


def skinning_matrices(
    axis_angles_rad: Float[Tensor, "k c 3"], shift_m: Float[Tensor, "k 3"], skeleton: Skeleton, fitted: FittedPoses
) -> Float[Tensor, "k j 4 4"]:
    """Return the matrices that move canonical points into the posed space of each frame.

    Differentiable in the corrections. Local rotation of a joint: fitted rotation times exp(correction).

    Args:
        axis_angles_rad: correction of each corrected joint, axis times angle.
        shift_m: correction of the root position, in world space.
    """
    if not runs_on_numba(axis_angles_rad, shift_m):
        return reference.skinning_matrices(axis_angles_rad, shift_m, skeleton, fitted)
    return _Kinematics.apply(axis_angles_rad.contiguous(), shift_m.contiguous(), skeleton, fitted)
