"""Plain-torch reference of the Broyden search: all points at once, any dtype, any device."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pipeline.kernels.broyden.cpu import SearchLimits
from pipeline.kernels.inverse_skinning.reference import Lattice, gather


def find_roots(
    posed_m: Float[Tensor, "n 3"],
    frame: Int[Tensor, "n"],
    posed_to_start: Float[Tensor, "k b 12"],
    blended: Float[Tensor, "m k 12"],
    lattice: Lattice,
    limits: SearchLimits,
    candidates: int,
) -> tuple[Float[Tensor, "n c 3"], Bool[Tensor, "n c"]]:
    """Do `pipeline.kernels.broyden.find_roots` with inverse bone matrices, up to `candidates` roots."""
    roots = posed_m.new_zeros(len(posed_m), candidates, 3)
    exists = torch.zeros(len(posed_m), candidates, dtype=torch.bool, device=posed_m.device)
    for row in range(len(posed_to_start)):
        chosen = torch.nonzero(frame == row)[:, 0]
        for bone in range(posed_to_start.shape[1]):
            matrix = posed_to_start[row, bone].view(3, 4)
            start = posed_m[chosen] @ matrix[:, :3].T + matrix[:, 3]
            found, converged = _iterate(start, posed_m[chosen], blended[:, row], lattice, limits)
            _append_new_roots(found, converged, chosen, roots, exists, limits.duplicate)
    return roots, exists


def _iterate(
    x: Tensor, posed: Tensor, blended: Tensor, lattice: Lattice, limits: SearchLimits
) -> tuple[Tensor, Tensor]:
    """Return the last iterate of Broyden's method from each start (s, 3), and whether it is a root."""
    iterations, converged_m, diverged_m, _ = limits
    matrix, alive = _blend(x, blended, lattice)
    alive &= torch.linalg.det(matrix[:, :, :3]).abs() > 1e-3
    inverse = torch.linalg.inv(
        torch.where(alive[:, None, None], matrix[:, :, :3], torch.eye(3, dtype=x.dtype, device=x.device))
    )
    residual = _transform_points(matrix, x) - posed
    for _ in range(iterations):
        active = alive & (residual.norm(dim=1) >= converged_m)
        delta_x = -(inverse @ residual[:, :, None])[:, :, 0] * active[:, None]
        x = x + delta_x
        matrix, inside = _blend(x, blended, lattice)
        after = torch.where(active[:, None], _transform_points(matrix, x) - posed, residual)
        alive &= ~active | (inside & (after.norm(dim=1) <= diverged_m))
        along = (delta_x[:, None] @ inverse)[:, 0]
        delta_residual = after - residual
        scale = (along * delta_residual).sum(1)
        updatable = active & (scale.abs() >= 1e-14)
        ahead = delta_x - (inverse @ delta_residual[:, :, None])[:, :, 0]
        step = ahead[:, :, None] * along[:, None] / torch.where(updatable, scale, torch.ones_like(scale))[:, None, None]
        inverse = inverse + step * updatable[:, None, None]
        residual = after
    return x, alive & (residual.norm(dim=1) < converged_m)


def _blend(x: Tensor, blended: Tensor, lattice: Lattice) -> tuple[Tensor, Tensor]:
    """Return the skinning matrices (s, 3, 4) at canonical points, and which are in cells with all their nodes."""
    origin_m, cell_m, row_of_node = lattice
    scaled = (x - origin_m.to(x)) / cell_m
    inside = ((scaled >= 0) & (scaled < torch.tensor(row_of_node.shape, device=x.device) - 1)).all(1)
    matrix, weight_sum = gather(torch.where(inside[:, None], x, torch.zeros_like(x)), lattice, blended)
    return matrix.view(-1, 3, 4), inside & (weight_sum > 1 - 1e-4)


def _transform_points(matrix: Tensor, x: Tensor) -> Tensor:
    return (matrix[:, :, :3] @ x[:, :, None])[:, :, 0] + matrix[:, :, 3]


def _append_new_roots(
    found: Tensor, converged: Tensor, chosen: Tensor, roots: Tensor, exists: Tensor, duplicate_m: float
) -> None:
    """Append new roots to the candidates of their points, up to the maximum number of candidates."""
    known = ((roots[chosen] - found[:, None]).norm(dim=2) <= duplicate_m) & exists[chosen]
    count = exists[chosen].sum(1)
    new = converged & ~known.any(1) & (count < exists.shape[1])
    roots[chosen[new], count[new]] = found[new]
    exists[chosen[new], count[new]] = True
