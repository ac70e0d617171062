"""Solution by the factors of a sparse system: against the dense solution, the definition in torch, and SuperLU."""

import numpy as np
import pytest
import torch
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu

from pipeline.geometry.linear_systems import factorise_positive_definite
from pipeline.kernels.cholesky_solve import CholeskyFactors, cholesky_solve


def laplacian_of_a_graph(count: int, seed: int) -> np.ndarray:
    """I + 5 L of a random connected graph with weights, (count, count), float64."""
    rng = np.random.default_rng(seed)
    matrix = np.eye(count)
    for end in range(1, count):
        for other in {end - 1, int(rng.integers(end)), int(rng.integers(end))}:
            weight = 5.0 * rng.uniform(0.1, 16.0)
            matrix[[end, other], [end, other]] += weight
            matrix[[end, other], [other, end]] -= weight
    return matrix


@pytest.mark.parametrize("count", [1, 2, 7, 300])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_solution_solves_the_system(count: int, dtype: torch.dtype) -> None:
    matrix = laplacian_of_a_graph(count, seed=count)
    factors = CholeskyFactors.from_superlu(factorise_positive_definite(csc_array(matrix)))
    right_side = torch.randn(count, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    expected = torch.from_numpy(np.linalg.solve(matrix, right_side.numpy()))
    found = cholesky_solve(factors, right_side.to(dtype))
    assert found.dtype == dtype
    # The factors are in single precision for both; the condition number is some hundreds.
    torch.testing.assert_close(found.double(), expected, atol=1e-5, rtol=1e-4)


def test_the_compiled_loops_equal_their_definition() -> None:
    matrix = laplacian_of_a_graph(200, seed=3)
    factors = CholeskyFactors.from_superlu(factorise_positive_definite(csc_array(matrix)))
    right_side = torch.randn(200, 3, generator=torch.Generator().manual_seed(2))
    definition = cholesky_solve(factors, right_side.double())
    torch.testing.assert_close(cholesky_solve(factors, right_side).double(), definition, atol=2e-6, rtol=2e-5)


def test_the_right_side_may_be_a_strided_view_and_stays_as_it_is() -> None:
    factors = CholeskyFactors.from_superlu(factorise_positive_definite(csc_array(laplacian_of_a_graph(50, seed=4))))
    wide = torch.randn(50, 5, generator=torch.Generator().manual_seed(3))
    before = wide.clone()
    torch.testing.assert_close(cholesky_solve(factors, wide[:, 1:4]), cholesky_solve(factors, wide[:, 1:4].clone()))
    assert torch.equal(wide, before)


def test_a_pivoted_factorisation_is_refused() -> None:
    pivoted = splu(csc_array(np.array([[1e-9, 1.0], [1.0, 0.0]])))
    with pytest.raises(ValueError, match="off the diagonal"):
        CholeskyFactors.from_superlu(pivoted)
