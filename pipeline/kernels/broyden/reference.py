"""Plain-torch twin of the Broyden search: all points and starts at once, any dtype, any device."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pipeline.kernels.inverse_skinning.reference import Lattice, gather


def search(
    posed_m: Float[Tensor, "n 3"],
    frame: Int[Tensor, "n"],
    posed_to_start: Float[Tensor, "k b 12"],
    blended: Float[Tensor, "m k 12"],
    lattice: Lattice,
    limits: tuple[int, float, float, float],
    candidates: int,
) -> tuple[Float[Tensor, "n c 3"], Bool[Tensor, "n c"]]:
    """Same as `pipeline.kernels.broyden.search`; `limits`: iterations, and metres of arrival, loss and sameness."""
    roots = posed_m.new_zeros(len(posed_m), candidates, 3)
    exists = torch.zeros(len(posed_m), candidates, dtype=torch.bool, device=posed_m.device)
    for row in range(len(posed_to_start)):
        chosen = torch.nonzero(frame == row)[:, 0]
        for bone in range(posed_to_start.shape[1]):
            matrix = posed_to_start[row, bone].view(3, 4)
            start = posed_m[chosen] @ matrix[:, :3].T + matrix[:, 3]
            found, arrived = _descend(start, posed_m[chosen], blended[:, row], lattice, limits)
            _keep(found, arrived, chosen, roots, exists, same_m=limits[3])
    return roots, exists


def _descend(
    x: Tensor, posed: Tensor, blended: Tensor, lattice: Lattice, limits: tuple[int, float, float, float]
) -> tuple[Tensor, Tensor]:
    """Where Broyden's method goes from each start (s, 3), and whether that is a root."""
    iterations, arrived_m, lost_m, _ = limits
    matrix, alive = _blend(x, blended, lattice)
    alive &= torch.linalg.det(matrix[:, :, :3]).abs() > 1e-3
    inverse = torch.linalg.inv(
        torch.where(alive[:, None, None], matrix[:, :, :3], torch.eye(3, dtype=x.dtype, device=x.device))
    )
    miss = _carry(matrix, x) - posed
    for _ in range(iterations):
        active = alive & (miss.norm(dim=1) >= arrived_m)
        move = -(inverse @ miss[:, :, None])[:, :, 0] * active[:, None]
        x = x + move
        matrix, inside = _blend(x, blended, lattice)
        after = torch.where(active[:, None], _carry(matrix, x) - posed, miss)
        alive &= ~active | (inside & (after.norm(dim=1) <= lost_m))
        along = (move[:, None] @ inverse)[:, 0]
        change = after - miss
        scale = (along * change).sum(1)
        sound = active & (scale.abs() >= 1e-14)
        ahead = move - (inverse @ change[:, :, None])[:, :, 0]
        step = ahead[:, :, None] * along[:, None] / torch.where(sound, scale, torch.ones_like(scale))[:, None, None]
        inverse = inverse + step * sound[:, None, None]
        miss = after
    return x, alive & (miss.norm(dim=1) < arrived_m)


def _blend(x: Tensor, blended: Tensor, lattice: Lattice) -> tuple[Tensor, Tensor]:
    """Skinning matrices (s, 3, 4) at canonical points, and which of these lie in cells with all their nodes."""
    origin_m, cell_m, row_of_node = lattice
    scaled = (x - origin_m.to(x)) / cell_m
    inside = ((scaled >= 0) & (scaled < torch.tensor(row_of_node.shape, device=x.device) - 1)).all(1)
    matrix, share = gather(torch.where(inside[:, None], x, torch.zeros_like(x)), lattice, blended)
    return matrix.view(-1, 3, 4), inside & (share > 1 - 1e-4)


def _carry(matrix: Tensor, x: Tensor) -> Tensor:
    return (matrix[:, :, :3] @ x[:, :, None])[:, :, 0] + matrix[:, :, 3]


def _keep(found: Tensor, arrived: Tensor, chosen: Tensor, roots: Tensor, exists: Tensor, same_m: float) -> None:
    """Add the roots that are new to the candidates of their points, as long as there is room."""
    known = ((roots[chosen] - found[:, None]).norm(dim=2) <= same_m) & exists[chosen]
    count = exists[chosen].sum(1)
    new = arrived & ~known.any(1) & (count < exists.shape[1])
    roots[chosen[new], count[new]] = found[new]
    exists[chosen[new], count[new]] = True
