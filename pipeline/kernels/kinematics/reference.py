"""Plain-torch reference of forward kinematics: any dtype, any device, gradients by autograd."""

import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.kernels.kinematics.inputs import FittedPoses, Skeleton


def skinning_matrices(
    axis_angles_rad: Float[Tensor, "k c 3"], shift_m: Float[Tensor, "k 3"], skeleton: Skeleton, fitted: FittedPoses
) -> Float[Tensor, "k j 4 4"]:
    """Do `pipeline.kernels.kinematics.skinning_matrices`."""
    joints_m = skeleton.joints_m.to(axis_angles_rad)
    fitted_rotations, root_m, world_to_posed = (tensor.to(axis_angles_rad) for tensor in fitted)
    corrections = torch.linalg.matrix_exp(_cross_product_matrix(axis_angles_rad))
    rigid_rotation = world_to_posed[:, :3, :3]
    rotations: list[Tensor] = []
    positions_m: list[Tensor] = []
    for joint, parent in enumerate(skeleton.parents.tolist()):
        local, row = fitted_rotations[:, joint], int(skeleton.correction_row[joint])
        if row >= 0:
            local = local @ corrections[:, row]
        if parent < 0:
            rotations.append(rigid_rotation @ local)
            positions_m.append((rigid_rotation @ (root_m + shift_m)[..., None])[..., 0] + world_to_posed[:, :3, 3])
        else:
            rotations.append(rotations[parent] @ local)
            positions_m.append(positions_m[parent] + rotations[parent] @ (joints_m[joint] - joints_m[parent]))
    rotation = torch.stack(rotations, dim=1)
    translation = torch.stack(positions_m, dim=1) - (rotation @ joints_m[..., None])[..., 0]
    last_row = rotation.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*rotation.shape[:2], 1, 4)
    return torch.cat([torch.cat([rotation, translation[..., None]], dim=-1), last_row], dim=-2)


def _cross_product_matrix(vector: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3 3"]:
    """Return K with K x = vector x x (cross product)."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    rows = ((zero, -z, y), (z, zero, -x), (-y, x, zero))
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
