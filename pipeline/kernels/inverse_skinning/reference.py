"""Plain-torch reference of inverse skinning: any dtype, any device, gradients by autograd."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pipeline.kernels.common.grid_corners import cell_corners, corner_offsets
from pipeline.kernels.common.packing import segment_ids_from_counts


class Lattice(NamedTuple):
    """Node positions of a skin grid: position of the first node, spacing, and row of each node, -1 if it is missing."""

    origin_m: Float[Tensor, "3"]
    cell_m: float
    row_of_node: Int[Tensor, "gx gy gz"]


def interpolate(points_m: Float[Tensor, "n 3"], lattice: Lattice, values: Float[Tensor, "m c"]) -> Float[Tensor, "n c"]:
    """Interpolate node values trilinearly, normalised over the nodes that exist.

    Points in cells without any node get the values of the nearest node.
    """
    origin_m, cell_m, row_of_node = lattice
    total, mass = gather(points_m, lattice, values)
    known = mass > 1e-6
    result = total / mass.clamp(min=1e-6)[:, None]
    if bool(known.all()):
        return result
    exists = row_of_node >= 0
    nodes_m = torch.nonzero(exists).to(points_m) * cell_m + origin_m.to(points_m)
    rows = row_of_node[exists].long()
    outside = torch.nonzero(~known)[:, 0]
    for part in outside.split(1024):
        nearest = torch.cdist(points_m[part].detach(), nodes_m).argmin(1)
        result = result.index_put((part,), values[rows[nearest]])
    return result


def gather(
    points_m: Float[Tensor, "n 3"], lattice: Lattice, values: Float[Tensor, "m c"]
) -> tuple[Float[Tensor, "n c"], Float[Tensor, "n"]]:
    """Return the weighted sum of the values at the eight corners, and the sum of the weights of those that exist."""
    row, axis_weights = _corners(points_m, lattice)
    weight = axis_weights.prod(-1) * (row >= 0)
    picked = values.index_select(0, row.clamp(min=0).view(-1)).view(*row.shape, -1)
    return (weight[..., None] * picked).sum(1), weight.sum(1)


def _corners(points_m: Float[Tensor, "n 3"], lattice: Lattice) -> tuple[Int[Tensor, "n 8"], Float[Tensor, "n 8 3"]]:
    """Return the rows of the nodes around each point, -1 for missing ones, and their weights along each axis."""
    origin_m, cell_m, row_of_node = lattice
    cells = torch.tensor(row_of_node.shape, device=points_m.device) - 1
    corner, axis_weights = cell_corners((points_m - origin_m.to(points_m)) / cell_m, cells, clamp=True)
    return row_of_node[corner.unbind(-1)].long(), axis_weights


def skin_points(
    points_m: Float[Tensor, "n 3"], blended: Float[Tensor, "m 12"], lattice: Lattice
) -> Float[Tensor, "n 3"]:
    """Move canonical points into the pose: A(x) x."""
    return _transform_points(interpolate(points_m, lattice, blended).view(-1, 3, 4), points_m)


def _transform_points(matrix: Float[Tensor, "n 3 4"], points_m: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    return (matrix[:, :, :3] * points_m[:, None]).sum(-1) + matrix[:, :, 3]


def newton_step(
    blended: Float[Tensor, "m k 12"],
    start_m: Float[Tensor, "s 3"],
    posed_m: Float[Tensor, "s 3"],
    frame_offsets: Int[Tensor, "k1"],
    lattice: Lattice,
) -> Float[Tensor, "s 3"]:
    """Do `pipeline.kernels.inverse_skinning.newton_step`: x + J^-1 (p - A x), with J and x of the start.

    Only A has a gradient, so that the gradient of the step is the implicit one.
    """
    frames, start_m, posed_m = blended.shape[1], start_m.detach(), posed_m.detach()
    batch_index = segment_ids_from_counts(frame_offsets.diff())
    node, axis_weights = _corners(start_m, lattice)
    exists = node >= 0
    # Rows of one table: the matrices of all frames of a node are consecutive.
    row = node.clamp(min=0) * frames + batch_index[:, None]
    corner_matrix = blended.flatten(0, 1).index_select(0, row.view(-1)).view(-1, 8, 3, 4)
    weight = axis_weights.prod(-1) * exists
    matrix = (weight[..., None, None] * corner_matrix).sum(1)
    jacobian = _jacobian(start_m, corner_matrix.detach(), axis_weights, exists, lattice[1]) + matrix.detach()[..., :3]
    determinant, adjugate = _adjugate(jacobian)
    invertible = (weight.sum(1) > 1 - 1e-4) & (determinant.abs() > 1e-3)
    inverse = adjugate * (invertible / torch.where(invertible, determinant, 1.0))[:, None, None]
    return start_m + (inverse * (posed_m - _transform_points(matrix, start_m))[:, None]).sum(-1)


def _jacobian(
    points_m: Float[Tensor, "s 3"],
    corner_matrix: Float[Tensor, "s 8 3 4"],
    axis_weights: Float[Tensor, "s 8 3"],
    exists: Bool[Tensor, "s 8"],
    cell_m: float,
) -> Float[Tensor, "s 3 3"]:
    """Return the part of d(A(x) x)/dx due to the change of the weights: corner images times weight gradients."""
    x, y, z = axis_weights.unbind(-1)
    sign = 2 * corner_offsets(points_m.device) - 1
    gradient = torch.stack([y * z, x * z, x * y], -1) * sign * exists[..., None] / cell_m
    image_m = (corner_matrix[..., :3] * points_m[:, None, None]).sum(-1) + corner_matrix[..., 3]
    return (image_m[..., None] * gradient[..., None, :]).sum(1)


def _adjugate(matrix: Float[Tensor, "s 3 3"]) -> tuple[Float[Tensor, "s"], Float[Tensor, "s 3 3"]]:
    """Return determinant and adjugate, whose quotient is the inverse."""
    a, b, c = matrix.unbind(1)
    columns = torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)
    return (a * columns[0]).sum(-1), torch.stack(columns, -1)
