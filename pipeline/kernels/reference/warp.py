"""Plain-torch twin of inverse skinning: any dtype, any device, gradients by autograd."""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor


def interpolate(
    points_m: Float[Tensor, "n 3"],
    origin_m: np.ndarray,
    cell_m: float,
    row_of_node: Int[np.ndarray, "gx gy gz"],
    values: Float[Tensor, "m c"],
) -> Float[Tensor, "n c"]:
    """Trilinear interpolation of node values; nodes that do not exist have no share in it.

    Points in cells without any node get the values of the nearest node.
    """
    total, mass = gather(points_m, origin_m, cell_m, row_of_node, values)
    known = mass > 1e-6
    result = total / mass.clamp(min=1e-6)[:, None]
    if bool(known.all()):
        return result
    nodes = torch.from_numpy(np.argwhere(row_of_node >= 0)).to(points_m) * cell_m
    nodes = nodes + torch.as_tensor(origin_m).to(points_m)
    rows = torch.from_numpy(row_of_node[row_of_node >= 0]).to(points_m.device).long()
    lost = torch.nonzero(~known)[:, 0]
    for part in lost.split(1024):
        nearest = torch.cdist(points_m[part].detach(), nodes).argmin(1)
        result = result.index_put((part,), values[rows[nearest]])
    return result


def gather(
    points_m: Tensor, origin_m: np.ndarray, cell_m: float, row_of_node: np.ndarray, values: Tensor
) -> tuple[Tensor, Tensor]:
    """Weighted sum (n, c) of the eight corners' values, and the sum (n) of the weights of those that exist."""
    rows = torch.as_tensor(row_of_node, device=points_m.device).long()
    size = torch.tensor(rows.shape, device=points_m.device)
    scaled = (points_m - torch.as_tensor(origin_m).to(points_m)) / cell_m
    low = torch.minimum(scaled.detach().floor().long().clamp(min=0), size - 2)
    part = (scaled - low).clamp(0, 1)
    total, mass = values.new_zeros(len(points_m), values.shape[1]), torch.zeros_like(part[:, 0])
    for corner in range(8):
        bits = torch.tensor([corner & 1, corner >> 1 & 1, corner >> 2 & 1], device=points_m.device)
        row = rows[tuple((low + bits).unbind(-1))]
        weight = torch.where(bits == 1, part, 1 - part).prod(-1) * (row >= 0)
        total = total + weight[:, None] * values[row.clamp(min=0)]
        mass = mass + weight
    return total, mass


def skin_points(
    points_m: Float[Tensor, "n 3"],
    blended: Float[Tensor, "m 12"],
    origin_m: np.ndarray,
    cell_m: float,
    row_of_node: Int[np.ndarray, "gx gy gz"],
) -> Float[Tensor, "n 3"]:
    """Canonical points carried into the pose: A(x) x."""
    matrix = interpolate(points_m, origin_m, cell_m, row_of_node, blended).view(-1, 3, 4)
    return (matrix[:, :, :3] @ points_m[:, :, None])[:, :, 0] + matrix[:, :, 3]


def newton(
    blended: Float[Tensor, "m k 12"],
    start_m: Float[Tensor, "s 3"],
    posed_m: Float[Tensor, "s 3"],
    slot_start: Int[Tensor, "k1"],
    origin_m: np.ndarray,
    cell_m: float,
    row_of_node: Int[np.ndarray, "gx gy gz"],
) -> Float[Tensor, "s 3"]:
    """Same as `pipeline.kernels.warp.newton`.

    To the step, which has no gradient, -J^-1 (A x - A x detached) is added, with J and x of the start: zero in value,
    with the implicit gradient.
    """
    parts = []
    grid = (origin_m, cell_m, row_of_node)
    for frame in range(blended.shape[1]):
        start = start_m[slot_start[frame] : slot_start[frame + 1]].detach()
        posed = posed_m[slot_start[frame] : slot_start[frame + 1]].detach()
        with torch.no_grad():
            solution = start + _solve(start, posed, blended[:, frame], grid)
        image = skin_points(start, blended[:, frame], *grid)
        parts.append(solution + _solve(start, image, blended[:, frame].detach(), grid, forward=False))
    return torch.cat(parts)


def _solve(
    points: Tensor, posed: Tensor, blended: Tensor, grid: tuple[np.ndarray, float, np.ndarray], forward: bool = True
) -> Tensor:
    """J(points)^-1 (posed - A x) if forward, else -J^-1 (posed - detached posed): zero in value, with a gradient."""
    known = gather(points, *grid, blended.detach())[1] > 1 - 1e-4
    inputs = points.detach().requires_grad_(True)
    with torch.enable_grad():
        carried = skin_points(inputs, blended.detach(), *grid)
        rows = [torch.autograd.grad(carried[:, axis].sum(), inputs, retain_graph=True)[0] for axis in range(3)]
    jacobian = torch.stack(rows, 1)
    sound = known & (torch.linalg.det(jacobian).abs() > 1e-3)
    jacobian = torch.where(sound[:, None, None], jacobian, torch.eye(3).to(jacobian))
    right = posed - carried.detach() if forward else posed.detach() - posed
    return torch.linalg.solve(jacobian, right) * sound[:, None]
