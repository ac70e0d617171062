"""Inverse skinning by Broyden's method from several starts: what the baked warp grid is compared with.

SNARF (Chen et al. 2021), Fast-SNARF (Chen et al. 2023) and InstantAvatar (Jiang et al. 2023): every posed point is
carried back rigidly by each of a few bones, and from each such start Broyden's good update looks for a root of
A(x) x = p. Starts that leave the skin grid or diverge are given up, roots found twice are counted once.

Letters: n posed points, k frames, b starting bones, m nodes of the skin grid, c candidates.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pipeline.kernels.broyden import cpu as broyden_cpu
from pipeline.kernels.broyden import reference
from pipeline.kernels.common.dispatch import runs_on_numba
from pipeline.kernels.inverse_skinning import SkinGrid

ITERATIONS = 10
CONVERGED_M, DIVERGED_M = 1e-5, 0.1
"""Residuals at which a search has arrived, or is given up (Fast-SNARF's)."""
DUPLICATE_ROOT_M = 1e-3
CANDIDATES = 4
"""Roots kept of a point, as many as a cell of the warp grid has."""


def find_roots(
    posed_m: Float[Tensor, "n 3"],
    frame: Int[Tensor, "n"],
    bone_to_posed: Float[Tensor, "k b 4 4"],
    blended: Float[Tensor, "m k 12"],
    skin: SkinGrid,
) -> tuple[Float[Tensor, "n c 3"], Bool[Tensor, "n c"]]:
    """Canonical points that skinning carries to `posed_m`, and which of the candidates exist. No gradient.

    Args:
        frame: row of `bone_to_posed`, column of `blended`, that each point belongs to, int64.
        bone_to_posed: rigid skinning matrices of the bones to start from; earlier bones come first among candidates.
        blended: `SkinGrid.blend` of the frames.
    """
    starts = torch.linalg.inv(bone_to_posed.detach())[:, :, :3].reshape(*bone_to_posed.shape[:2], 12).contiguous()
    limits = (ITERATIONS, CONVERGED_M, DIVERGED_M, DUPLICATE_ROOT_M)
    if not runs_on_numba(posed_m, starts, blended):
        return reference.find_roots(posed_m.detach(), frame, starts, blended.detach(), skin.lattice, limits, CANDIDATES)
    roots, counts = np.zeros((len(posed_m), CANDIDATES, 3), np.float32), np.zeros(len(posed_m), np.int64)
    points, table = posed_m.detach().contiguous().numpy(), blended.detach().contiguous().numpy()
    origin, cell, rows = skin.origin_m.numpy(), np.float32(skin.cell_m), skin.row_of_node.numpy()
    residuals = [np.float32(limit) for limit in limits[1:]]
    broyden_cpu.find_roots(
        points, frame.numpy(), starts.numpy(), table, origin, cell, rows, ITERATIONS, *residuals, roots, counts
    )
    return torch.from_numpy(roots), torch.arange(CANDIDATES) < torch.from_numpy(counts)[:, None]
