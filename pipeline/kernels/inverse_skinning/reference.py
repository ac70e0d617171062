"""Plain-torch twin of inverse skinning: any dtype, any device, gradients by autograd."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pipeline.kernels.common.grid_corners import cell_corners, corner_offsets
from pipeline.kernels.common.packing import segment_ids_from_counts

Lattice = tuple[Float[Tensor, "3"], float, Int[Tensor, "gx gy gz"]]
"""Where the nodes of a skin grid are: the place of the first (m), their distance (m), and the row of each that exists,
-1 of others."""


def interpolate(points_m: Float[Tensor, "n 3"], lattice: Lattice, values: Float[Tensor, "m c"]) -> Float[Tensor, "n c"]:
    """Trilinear interpolation of node values; nodes that do not exist have no share in it.

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
    lost = torch.nonzero(~known)[:, 0]
    for part in lost.split(1024):
        nearest = torch.cdist(points_m[part].detach(), nodes_m).argmin(1)
        result = result.index_put((part,), values[rows[nearest]])
    return result


def gather(
    points_m: Float[Tensor, "n 3"], lattice: Lattice, values: Float[Tensor, "m c"]
) -> tuple[Float[Tensor, "n c"], Float[Tensor, "n"]]:
    """Weighted sum of the eight corners' values, and the sum of the weights of those that exist."""
    row, axis_weights = _corners(points_m, lattice)
    weight = axis_weights.prod(-1) * (row >= 0)
    picked = values.index_select(0, row.clamp(min=0).view(-1)).view(*row.shape, -1)
    return (weight[..., None] * picked).sum(1), weight.sum(1)


def _corners(points_m: Float[Tensor, "n 3"], lattice: Lattice) -> tuple[Int[Tensor, "n 8"], Float[Tensor, "n 8 3"]]:
    """Rows of the nodes around each point, -1 where there is none, and their shares along each axis."""
    origin_m, cell_m, row_of_node = lattice
    cells = torch.tensor(row_of_node.shape, device=points_m.device) - 1
    corner, axis_weights = cell_corners((points_m - origin_m.to(points_m)) / cell_m, cells, clamp=True)
    return row_of_node[corner.unbind(-1)].long(), axis_weights


def skin_points(
    points_m: Float[Tensor, "n 3"], blended: Float[Tensor, "m 12"], lattice: Lattice
) -> Float[Tensor, "n 3"]:
    """Canonical points carried into the pose: A(x) x."""
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
    """Same as `pipeline.kernels.inverse_skinning.newton_step`: J^-1 (p - A x) is added to x, with J and x of the start.

    Of that only A has a gradient, so the step's own gradient is the implicit one.
    """
    frames, start_m, posed_m = blended.shape[1], start_m.detach(), posed_m.detach()
    batch_index = segment_ids_from_counts(frame_offsets.diff())
    node, axis_weights = _corners(start_m, lattice)
    exists = node >= 0
    # The matrices of all frames are rows of one table, those of a node one behind the other.
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
    """What the change of the weights adds to A in the derivative of A(x) x: the corners' images times the gradients of
    their weights, each the product of the other two shares.
    """
    x, y, z = axis_weights.unbind(-1)
    sign = 2 * corner_offsets(points_m.device) - 1
    gradient = torch.stack([y * z, x * z, x * y], -1) * sign * exists[..., None] / cell_m
    image_m = (corner_matrix[..., :3] * points_m[:, None, None]).sum(-1) + corner_matrix[..., 3]
    return (image_m[..., None] * gradient[..., None, :]).sum(1)


def _adjugate(matrix: Float[Tensor, "s 3 3"]) -> tuple[Float[Tensor, "s"], Float[Tensor, "s 3 3"]]:
    """Determinant and adjugate: their quotient is the inverse, with no solver for each sample."""
    a, b, c = matrix.unbind(1)
    columns = torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)
    return (a * columns[0]).sum(-1), torch.stack(columns, -1)
