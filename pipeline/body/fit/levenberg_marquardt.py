"""Levenberg-Marquardt on all frames at once.

The normal matrix is banded over time (a dense block for each frame, diagonals that couple it with the next two frames)
and bordered by the shared parameters, so a step costs O(n p^3). Damping after Marquardt, "An algorithm for
least-squares estimation of nonlinear parameters", 1963.

Dimensions: n frames, p parameters of a frame, g shared parameters, r residuals of a frame.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.linalg import cho_factor, cho_solve, cholesky_banded
from scipy.linalg.lapack import dtbtrs
from torch import Tensor

DAMPING_START = 1e-3
DAMPING_UP = 8.0
DAMPING_DOWN = 0.3
DAMPING_LIMIT = 1e6


@dataclass
class NormalEquations:
    """Sums of w J^T J and w J^T r, and the robust cost; float64.

    border: products of frame and shared parameters.
    next_frame_coupling, second_next_frame_coupling: row t is the diagonal block that couples frame t with t + 1, t + 2.
    """

    frame_hessian: Float[Tensor, "n p p"]
    border: Float[Tensor, "n p g"]
    shared_hessian: Float[Tensor, "g g"]
    frame_gradient: Float[Tensor, "n p"]
    shared_gradient: Float[Tensor, "g"]
    next_frame_coupling: Float[Tensor, "n p"]
    second_next_frame_coupling: Float[Tensor, "n p"]
    cost: float = 0.0

    @classmethod
    def zeros(cls, frame_count: int, parameters_per_frame: int, shared_count: int) -> "NormalEquations":
        """Return an empty system."""

        zeros = partial(torch.zeros, dtype=torch.float64)

        return cls(
            frame_hessian=zeros(frame_count, parameters_per_frame, parameters_per_frame),
            border=zeros(frame_count, parameters_per_frame, shared_count),
            shared_hessian=zeros(shared_count, shared_count),
            frame_gradient=zeros(frame_count, parameters_per_frame),
            shared_gradient=zeros(shared_count),
            next_frame_coupling=zeros(frame_count, parameters_per_frame),
            second_next_frame_coupling=zeros(frame_count, parameters_per_frame),
        )

    def accumulate(
        self,
        frame_jacobian: Float[Tensor, "n r p"],
        shared_jacobian: Float[Tensor, "n r g"],
        residual: Float[Tensor, "n r"],
        weight: Float[Tensor, "n r"],
    ) -> None:
        """Add residuals that depend on the parameters of one frame and the shared ones. Their cost is not added.

        Products have the precision of the Jacobians, sums over terms are float64.
        """
        weight, residual = weight.to(frame_jacobian), residual.to(frame_jacobian)
        weighted = frame_jacobian * weight[..., None]
        weighted_shared = (shared_jacobian * weight[..., None]).flatten(0, 1)
        self.frame_hessian += weighted.transpose(1, 2) @ frame_jacobian
        self.border += weighted.transpose(1, 2) @ shared_jacobian
        self.shared_hessian += weighted_shared.T @ shared_jacobian.flatten(0, 1)
        self.frame_gradient += (weighted * residual[..., None]).sum(1)
        self.shared_gradient += weighted_shared.T @ residual.flatten()

    def add_frames(self, rows: slice, part: "NormalEquations") -> None:
        """Add the system of some frames, without couplings between frames."""
        self.frame_hessian[rows] += part.frame_hessian
        self.border[rows] += part.border
        self.shared_hessian += part.shared_hessian
        self.frame_gradient[rows] += part.frame_gradient
        self.shared_gradient += part.shared_gradient
        self.cost += part.cost

    def fix_parameters(self, free: Bool[Tensor, "g"]) -> None:
        """Remove the shared parameters that are not free from the system: their step becomes zero."""
        self.border[:, :, ~free] = 0.0
        self.shared_hessian[~free] = 0.0
        self.shared_hessian[:, ~free] = 0.0
        self.shared_hessian[~free, ~free] = 1.0
        self.shared_gradient[~free] = 0.0


def robust_weights(
    system: NormalEquations, squared: Float[Tensor, "*n"], cutoff: float, share: Float[Tensor, "*n"] | float = 1.0
) -> Float[Tensor, "*n"]:
    """Return the Geman-McClure weights rho'(r) of squared residuals, and add their cost to the system.

    squared: squared residuals in standard deviations. cutoff: in standard deviations. share: factor on the cost.
    """
    relative = 1.0 + squared / cutoff**2
    system.cost += float((share * squared / relative).sum())
    return relative**-2


def _banded_factor(system: NormalEquations, damping: float) -> np.ndarray:
    """Return the lower banded Cholesky factor of the frames' part, with the diagonal multiplied by 1 + damping."""
    n, p = system.frame_gradient.shape
    band = np.zeros((2 * p + 1, n, p))
    rows, columns = np.tril_indices(p)
    band[rows - columns, :, columns] = system.frame_hessian[:, rows, columns].numpy().T
    band[0] = band[0] * (1.0 + damping) + 1e-9
    band[p] = system.next_frame_coupling.numpy()
    band[2 * p] = system.second_next_frame_coupling.numpy()
    return cholesky_banded(band.reshape(2 * p + 1, n * p), lower=True, check_finite=False)


def _schur_complement(
    system: NormalEquations, factor: np.ndarray, damping: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Eliminate the frames; return the reduced matrix, and border and gradient times the inverse of the factor."""
    n, p = system.frame_gradient.shape
    border = system.border.reshape(n * p, -1).numpy()
    right = np.concatenate([border, system.frame_gradient.reshape(-1, 1).numpy()], axis=1)
    halfway = _substitute(factor, right)
    shared = system.shared_hessian.numpy().copy()
    shared[np.diag_indices_from(shared)] *= 1.0 + damping
    return shared - halfway[:, :-1].T @ halfway[:, :-1], halfway[:, :-1], halfway[:, -1]


def _substitute(factor: np.ndarray, right: np.ndarray, *, transposed: bool = False) -> np.ndarray:
    """Solve L x = right, or its transpose, with the lower banded Cholesky factor L."""
    solution: np.ndarray = dtbtrs(factor, right, uplo="L", trans="T" if transposed else "N")[0]
    return solution


def solve(system: NormalEquations, damping: float) -> tuple[Float[Tensor, "n p"], Float[Tensor, "g"]]:
    """Return the damped step of the frame parameters and of the shared parameters.

    Raises:
        numpy.linalg.LinAlgError: the damped normal matrix is not positive definite.
    """
    n, p = system.frame_gradient.shape
    factor = _banded_factor(system, damping)
    matrix, border, gradient = _schur_complement(system, factor, damping)
    right = system.shared_gradient.numpy() - border.T @ gradient
    shared_step = -cho_solve(cho_factor(matrix, check_finite=False), right, check_finite=False)
    frame_step = -_substitute(factor, gradient + border @ shared_step, transposed=True)
    return torch.from_numpy(frame_step.reshape(n, p)), torch.from_numpy(shared_step)


def shared_covariance(system: NormalEquations) -> Float[np.ndarray, "g g"]:
    """Return the covariance of the shared parameters, marginalised over the frames, for residuals of unit variance."""
    matrix, _, _ = _schur_complement(system, _banded_factor(system, 0.0), 0.0)
    return np.linalg.inv(matrix)


State = TypeVar("State")


def minimise(
    state: State,
    evaluate: Callable[[State], NormalEquations],
    retract: Callable[[State, Tensor, Tensor], State],
    iterations: int,
    tolerance: float = 1e-3,
) -> tuple[State, NormalEquations]:
    """Minimise an energy until a step lowers its cost by less than `tolerance`, relative to the cost.

    evaluate: returns the normal equations at a state. retract: returns the state after (frame step, shared step).
    Returns the state with the lowest cost and its normal equations.
    """
    system, damping = evaluate(state), DAMPING_START
    for _ in range(iterations):
        trial = retract(state, *solve(system, damping))
        trial_system = evaluate(trial)
        if trial_system.cost < system.cost:
            gain = (system.cost - trial_system.cost) / max(system.cost, 1e-12)
            state, system, damping = trial, trial_system, max(damping * DAMPING_DOWN, 1e-7)
            if gain < tolerance:
                break
        else:
            damping *= DAMPING_UP
            if damping > DAMPING_LIMIT:
                break
    return state, system
