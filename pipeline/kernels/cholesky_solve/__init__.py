"""Solution of a sparse symmetric positive definite system, factorised once, for many right-hand sides.

The factors of SuperLU are kept in single precision, and its solver is not used: it takes two to four times as long
(docs/decisions/engineering.md). Notation: n unknowns, e entries below the diagonal.
"""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.sparse.linalg import SuperLU
from torch import Tensor

from pipeline.kernels.cholesky_solve import cpu, reference
from pipeline.kernels.common.dispatch import runs_on_numba


class CholeskyFactors(NamedTuple):
    """P A Pᵀ = L D Lᵀ with a unit lower triangular L and a diagonal D.

    column_offsets, row, value: entries of L below the diagonal, column after column (CSC). inverse_diagonal: of D.
    position: row of the factors for each unknown.
    """

    column_offsets: Int[Tensor, "n1"]
    row: Int[Tensor, "e"]
    value: Float[Tensor, "e"]
    inverse_diagonal: Float[Tensor, "n"]
    position: Int[Tensor, "n"]

    @staticmethod
    def from_superlu(factorisation: SuperLU) -> "CholeskyFactors":
        """Convert a factorisation of a symmetric matrix without pivoting.

        Raises:
            ValueError: rows and columns are ordered differently, as pivoting does.
        """
        if not np.array_equal(factorisation.perm_r, factorisation.perm_c):
            raise ValueError("the factorisation has pivots off the diagonal; use factorise_positive_definite")
        lower = factorisation.L.tocsc()
        lower.sort_indices()
        # The first entry of each column is the 1 on the diagonal.
        below = np.ones(lower.nnz, dtype=bool)
        below[lower.indptr[:-1]] = False
        column_offsets = lower.indptr.astype(np.int64) - np.arange(len(lower.indptr))
        arrays = (
            column_offsets,
            lower.indices[below].astype(np.int32),
            lower.data[below].astype(np.float32),
            (1.0 / factorisation.U.diagonal()).astype(np.float32),
            factorisation.perm_r.astype(np.int64),
        )
        return CholeskyFactors(*(torch.from_numpy(array) for array in arrays))


def cholesky_solve(factors: CholeskyFactors, right_side: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Return x of A x = right_side; not differentiable."""
    if not runs_on_numba(factors.value, right_side):
        return reference.cholesky_solve(*factors, right_side)
    arrays = (tensor.detach().contiguous().numpy() for tensor in (*factors, right_side))
    return torch.from_numpy(cpu.cholesky_solve(*arrays))
