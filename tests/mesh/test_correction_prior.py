"""Priors of corrections against dense linear algebra and the definition of the Gaussian process."""

import numpy as np

from pipeline.body.pose_correction import correlation_time_s
from pipeline.mesh.correction_prior import (
    LEAST_STD_M,
    ROTATION_DRIFT_RAD_PER_SQRT_S,
    ROTATION_STD_RAD,
    SHIFT_DRIFT_M_PER_SQRT_S,
    SHIFT_STD_M,
    CorrectionPrior,
    drifting_prior,
    independent_prior,
    prior_given_others,
)

TIME_S = np.array([0.0, 0.1, 0.4, 0.5])
SIZE = 6


def dense(prior: CorrectionPrior) -> np.ndarray:
    """The precision matrix of all parameters of all frames, frame by frame."""
    matrix = np.diag(prior.diagonal.ravel())
    links = np.diag(prior.links.ravel(), SIZE)
    return matrix + links + links.T


def test_the_drifting_prior_is_that_of_its_residuals() -> None:
    count = len(TIME_S)
    std = np.array([ROTATION_STD_RAD] * 3 + [SHIFT_STD_M] * 3)
    drift = np.array([ROTATION_DRIFT_RAD_PER_SQRT_S] * 3 + [SHIFT_DRIFT_M_PER_SQRT_S] * 3)
    rows = [np.kron(np.eye(count), np.diag(1.0 / std))]
    for k in range(count - 1):
        row = np.zeros((SIZE, count * SIZE))
        row[:, k * SIZE : (k + 1) * SIZE] = -np.diag(1.0 / (drift * np.sqrt(TIME_S[k + 1] - TIME_S[k])))
        row[:, (k + 1) * SIZE : (k + 2) * SIZE] = -row[:, k * SIZE : (k + 1) * SIZE]
        rows.append(row)
    residuals = np.concatenate(rows)
    np.testing.assert_allclose(dense(drifting_prior(TIME_S, SIZE)), residuals.T @ residuals, rtol=1e-10, atol=1e-8)


def test_the_banded_solution_is_that_of_the_dense_system() -> None:
    random, count = np.random.default_rng(0), len(TIME_S)
    factors = random.normal(size=(count, 9, SIZE)) * 40.0
    matrices, vectors = factors.transpose(0, 2, 1) @ factors, random.normal(size=(count, SIZE)) * 50.0
    present = random.normal(size=(count, SIZE)) * 0.01
    prior = drifting_prior(TIME_S, SIZE)
    system = dense(prior)
    right = vectors.ravel() - system @ present.ravel()
    for k in range(count):
        system[k * SIZE : (k + 1) * SIZE, k * SIZE : (k + 1) * SIZE] += matrices[k]
    expected = np.linalg.solve(system, right).reshape(count, SIZE)
    np.testing.assert_allclose(prior.solve(matrices, vectors, present), expected, rtol=1e-8, atol=1e-12)


def test_independent_frames_do_not_know_each_other() -> None:
    found = dense(independent_prior(3, SIZE, width=2.0))
    std = 2.0 * np.array([ROTATION_STD_RAD] * 3 + [SHIFT_STD_M] * 3)
    np.testing.assert_allclose(found, np.diag(np.tile(1.0 / std**2, 3)))


def test_the_prior_given_others_is_the_conditional_of_the_gaussian_process() -> None:
    """Covariance by the formula for Gaussians; gaps of several free frames, free frames at both ends."""
    random = np.random.default_rng(1)
    time_s = np.cumsum(random.uniform(0.05, 0.2, 9))
    is_known = np.array([0, 1, 1, 0, 0, 1, 0, 1, 0], dtype=bool)
    known = np.cumsum(random.normal(size=(is_known.sum(), SIZE)), axis=0) * np.repeat([0.02, 0.005], 3)
    prior = prior_given_others(time_s, is_known, known)
    correlation_s = correlation_time_s(time_s[is_known], known)
    process = np.exp(-np.abs(time_s[:, None] - time_s) / correlation_s)
    free = ~is_known
    across = process[np.ix_(free, is_known)]
    conditional = process[np.ix_(free, free)] - across @ np.linalg.solve(process[np.ix_(is_known, is_known)], across.T)
    variance = np.repeat([np.square(known[:, :3]).mean(), np.square(known[:, 3:]).mean()], 3)
    expected = np.kron(conditional, np.diag(variance))
    np.testing.assert_allclose(np.linalg.inv(dense(prior)), expected, rtol=1e-6, atol=1e-12)


def test_corrections_that_are_all_zero_leave_some_freedom() -> None:
    prior = prior_given_others(TIME_S, np.array([True, False, True, True]), np.zeros((3, SIZE)))
    assert np.isfinite(prior.diagonal).all()
    assert prior.diagonal[0, -1] >= 1.0 / LEAST_STD_M**2
