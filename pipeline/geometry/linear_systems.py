"""Sparse linear systems of meshes."""

from typing import Any

from scipy.sparse import csc_array
from scipy.sparse.linalg import SuperLU, splu


def factorise_positive_definite(matrix: Any) -> SuperLU:
    """Factorise a symmetric positive definite sparse matrix.

    The ordering is that for symmetric matrices, and nothing is pivoted: the factors of a mesh's Laplacian have two
    thirds of the entries that the defaults of `splu` give.
    """
    return splu(csc_array(matrix), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
