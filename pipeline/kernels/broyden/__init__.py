"""Inverse skinning by Broyden's method from several starts: the baseline of the baked warp grid.

SNARF (Chen et al. 2021), Fast-SNARF (Chen et al. 2023) and InstantAvatar (Jiang et al. 2023): every posed point is
moved back rigidly by each of several bones. From each of these starts, Broyden's good update searches for a root of
A(x) x = p. A search ends without a root if it leaves the skin grid or diverges; duplicate roots are dropped.

Notation: n posed points, k frames, b starting bones, m nodes of the skin grid, c candidates.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pipeline.kernels.broyden import cpu, reference
from pipeline.kernels.broyden.cpu import SearchLimits
from pipeline.kernels.common.dispatch import runs_on_numba
from pipeline.kernels.inverse_skinning import SkinGrid

ITERATIONS = 10
CONVERGED_M, DIVERGED_M = 1e-5, 0.1
"""Residuals at which a search has converged or diverged (values of Fast-SNARF)."""
DUPLICATE_ROOT_M = 1e-3
CANDIDATES = 4
"""Maximum number of roots of a point, as in a cell of the warp grid."""


def find_roots(
    posed_m: Float[Tensor, "n 3"],
    frame: Int[Tensor, "n"],
    bone_to_posed: Float[Tensor, "k b 4 4"],
    blended: Float[Tensor, "m k 12"],
    skin: SkinGrid,
) -> tuple[Float[Tensor, "n c 3"], Bool[Tensor, "n c"]]:
    """Find the canonical points that skinning moves to `posed_m`. Not differentiable.

    Args:
        posed_m: points in posed space.
        frame: row of `bone_to_posed` and column of `blended` that each point belongs to, int64.
        bone_to_posed: rigid skinning matrices of the starting bones; roots of earlier bones come first.
        blended: `SkinGrid.blend` of the frames.

    Returns the candidates (m), and which of them exist.
    """
    starts = torch.linalg.inv(bone_to_posed.detach())[:, :, :3].reshape(*bone_to_posed.shape[:2], 12).contiguous()
    limits = SearchLimits(ITERATIONS, CONVERGED_M, DIVERGED_M, DUPLICATE_ROOT_M)
    if not runs_on_numba(posed_m, starts, blended):
        return reference.find_roots(posed_m.detach(), frame, starts, blended.detach(), skin.lattice, limits, CANDIDATES)
    roots, counts = np.zeros((len(posed_m), CANDIDATES, 3), np.float32), np.zeros(len(posed_m), np.int64)
    points, matrices = posed_m.detach().contiguous().numpy(), blended.detach().contiguous().numpy()
    lattice = skin.lattice_arrays()
    cpu.find_roots(points, frame.numpy(), starts.numpy(), lattice, matrices, limits, roots, counts)
    return torch.from_numpy(roots), torch.arange(CANDIDATES) < torch.from_numpy(counts)[:, None]
