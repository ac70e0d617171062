"""Plain-torch reference of the solution by factors: any dtype, any device, dense."""

import torch
from jaxtyping import Float, Int
from torch import Tensor


def cholesky_solve(
    column_offsets: Int[Tensor, "n1"],
    row: Int[Tensor, "e"],
    value: Float[Tensor, "e"],
    inverse_diagonal: Float[Tensor, "n"],
    position: Int[Tensor, "n"],
    right_side: Float[Tensor, "n 3"],
) -> Float[Tensor, "n 3"]:
    """Do `pipeline.kernels.cholesky_solve.cholesky_solve`, with the fields of `CholeskyFactors`."""
    lower = torch.eye(len(position)).to(right_side)
    column = torch.repeat_interleave(torch.arange(len(position), device=row.device), column_offsets.diff())
    lower[row.long(), column] = value.to(right_side)
    ordered = torch.empty_like(right_side)
    ordered[position] = right_side
    halfway = torch.linalg.solve_triangular(lower, ordered, upper=False, unitriangular=True)
    scaled = inverse_diagonal.to(right_side)[:, None] * halfway
    return torch.linalg.solve_triangular(lower.T, scaled, upper=True, unitriangular=True)[position]
