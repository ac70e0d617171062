"""Image positions of the vertices of a skinned mesh: linear blend skinning and perspective projection in one pass.

Notation: v vertices, j joints.
"""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.kernels.blend import SparseWeights
from pipeline.kernels.common.dispatch import runs_on_numba
from pipeline.kernels.skinned_projection import cpu, reference


def project_skinned(
    vertices: Float[Tensor, "v 3"],
    weights: SparseWeights,
    canonical_to_camera: Float[Tensor, "j 4 4"],
    intrinsics_px: tuple[float, float, float, float],
) -> tuple[Float[Tensor, "v 2"], Float[Tensor, "v"]]:
    """Pose vertices by linear blend skinning and project them; differentiable in the vertices.

    Args:
        vertices: canonical positions, m.
        weights: skin weights of the vertices.
        canonical_to_camera: skinning matrix of each joint, followed by the pose of the camera.
        intrinsics_px: fx, fy, cx, cy.

    Returns:
        Pixel positions (centres at +0.5), which are meaningless behind the camera, and depths in m.
    """
    matrices = canonical_to_camera[:, :3].reshape(-1, 12)
    if canonical_to_camera.requires_grad or not runs_on_numba(vertices, weights.weight, matrices):
        return reference.project_skinned(vertices, weights, matrices, intrinsics_px)
    return _ProjectSkinned.apply(vertices, weights, matrices, intrinsics_px)


class _ProjectSkinned(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, vertices: Tensor, weights: SparseWeights, matrices: Tensor, intrinsics_px: tuple[float, ...]
    ) -> tuple[Tensor, Tensor]:
        skin = cpu.SkinArrays(*(tensor.detach().contiguous().numpy() for tensor in (*weights, matrices)))
        ctx.save_for_backward(vertices)
        ctx.skin, ctx.intrinsics_px = skin, intrinsics_px
        projected = cpu.project_skinned(vertices.detach().contiguous().numpy(), skin, intrinsics_px)
        vertices_px, depth_m = (torch.from_numpy(array) for array in projected)
        return vertices_px, depth_m

    @staticmethod
    def backward(ctx: Any, grad_px: Tensor, grad_depth: Tensor) -> tuple[Tensor | None, ...]:
        arrays = (tensor.detach().contiguous().numpy() for tensor in (*ctx.saved_tensors, grad_px, grad_depth))
        return torch.from_numpy(cpu.project_skinned_backward(*arrays, ctx.skin, ctx.intrinsics_px)), None, None, None
