"""Priors of pose corrections over time: Gaussian processes whose precision matrix links successive frames only."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import solveh_banded

from pipeline.body.pose_correction import correlation_time_s

ROTATION_STD_RAD, ROTATION_DRIFT_RAD_PER_SQRT_S = np.radians(2.0), np.radians(1.5)
"""Standard deviation of the rotations that are corrected, and of their change in a second."""
SHIFT_STD_M, SHIFT_DRIFT_M_PER_SQRT_S = 0.02, 0.015
"""The same of the place of the root."""
LEAST_STD_RAD, LEAST_STD_M = np.radians(0.1), 0.001
"""Lower limits of the deviations that are estimated from corrections: zero would forbid all."""
MIN_INTERVAL_S = 1e-4


@dataclass(frozen=True)
class CorrectionPrior:
    """Precision matrix of p parameters a frame, independent of each other; in 1/rad² and 1/m².

    diagonal: of each frame. links: of each frame with the next.
    """

    diagonal: Float[np.ndarray, "n p"]
    links: Float[np.ndarray, "m p"]

    def solve(
        self,
        matrices: Float[np.ndarray, "n p p"],
        vectors: Float[np.ndarray, "n p"],
        present: Float[np.ndarray, "n p"],
    ) -> Float[np.ndarray, "n p"]:
        """Return the update of all corrections by one Gauss-Newton step.

        matrices, vectors: normal equations of each frame. present: corrections to which the update is added.
        """
        count, size = vectors.shape
        right = vectors - self.diagonal * present
        right[:-1] -= self.links * present[1:]
        right[1:] -= self.links * present[:-1]
        rows, columns = np.tril_indices(size)
        band = np.zeros((size + 1, count, size))
        band[rows - columns, :, columns] = (matrices + self.diagonal[:, :, None] * np.eye(size))[:, rows, columns].T
        band[size, :-1] = self.links
        return solveh_banded(band.reshape(size + 1, -1), right.ravel(), lower=True).reshape(count, size)


def drifting_prior(time_s: Float[np.ndarray, "n"], size: int) -> CorrectionPrior:
    """Return the prior of corrections with zero mean that drift over time.

    time_s: increasing. size: number of parameters; the last three are the shift of the root, the others rotations.
    """
    std = _of_parameters(size, ROTATION_STD_RAD, SHIFT_STD_M)
    drift = _of_parameters(size, ROTATION_DRIFT_RAD_PER_SQRT_S, SHIFT_DRIFT_M_PER_SQRT_S)
    links = 1.0 / (drift**2 * np.maximum(np.diff(time_s), MIN_INTERVAL_S)[:, None])
    diagonal = np.tile(1.0 / std**2, (len(time_s), 1))
    diagonal[:-1] += links
    diagonal[1:] += links
    return CorrectionPrior(diagonal, -links)


def independent_prior(count: int, size: int, width: float = 1.0) -> CorrectionPrior:
    """Return the prior of corrections with zero mean, of each frame alone; width: factor of the deviations."""
    std = width * _of_parameters(size, ROTATION_STD_RAD, SHIFT_STD_M)
    return CorrectionPrior(np.tile(1.0 / std**2, (count, 1)), np.zeros((count - 1, size)))


def _of_parameters(size: int, of_rotation: float, of_shift: float) -> Float[np.ndarray, "p"]:
    """Return a value for each parameter of a frame: all are rotations but the last three, the shift of the root."""
    return np.concatenate([np.full(size - 3, of_rotation), np.full(3, of_shift)])


def prior_given_others(
    time_s: Float[np.ndarray, "n"], is_known: Bool[np.ndarray, "n"], known: Float[np.ndarray, "k p"]
) -> CorrectionPrior:
    """Return the prior of the corrections of all other frames, given those of some, as `interpolate_corrections` does.

    Corrections are a Gaussian process of zero mean with the covariance std² exp(-interval / correlation time). The
    mean given the known ones is the interpolation; this is the precision about it. Deviations (of the three axes of a
    joint together) and the correlation time are those of the known corrections.

    Args:
        time_s: of all frames, increasing.
        is_known: frames whose corrections are known; at least one, and not all.
        known: their corrections (k = sum of is_known): rotation vectors of joints, rad, and the shift of the root, m.
    """
    by_axes = np.sqrt(np.square(known.reshape(len(known), -1, 3)).mean(axis=(0, 2)))
    least = np.full(len(by_axes), LEAST_STD_RAD)
    least[-1] = LEAST_STD_M
    precision = np.repeat(1.0 / np.square(np.maximum(by_axes, least)), 3)
    interval_s = np.maximum(np.diff(time_s), MIN_INTERVAL_S)
    correlation = np.exp(-interval_s / correlation_time_s(time_s[is_known], known))
    gain = 1.0 / -np.expm1(2.0 * np.log(correlation))
    # Of a Markov process: 1 / (1 - r²) at the ends; a frame between two others adds both, less 1.
    diagonal = np.ones(len(time_s))
    diagonal[:-1] += gain - 1.0
    diagonal[1:] += gain - 1.0
    free = np.flatnonzero(~is_known)
    is_next = np.diff(free) == 1
    links = np.where(is_next, (-correlation * gain)[np.minimum(free[:-1], len(gain) - 1)], 0.0)
    return CorrectionPrior(diagonal[free, None] * precision, links[:, None] * precision)
