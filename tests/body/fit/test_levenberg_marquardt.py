import numpy as np
import pytest
import torch

from pipeline.body.fit.levenberg_marquardt import NormalEquations, minimise, shared_covariance, solve

FRAMES, PARAMETERS, SHARED = 5, 3, 2


def random_system(shared: int = SHARED) -> tuple[NormalEquations, np.ndarray, np.ndarray]:
    """Return normal equations, and the same system as a dense matrix and gradient."""
    generator = torch.Generator().manual_seed(3)

    def random(*size: int) -> torch.Tensor:
        return torch.randn(*size, generator=generator, dtype=torch.float64)

    system = NormalEquations.zeros(FRAMES, PARAMETERS, shared)
    for _ in range(2):
        frame_step, shared_step = random(FRAMES, 6, PARAMETERS), random(FRAMES, 6, shared)
        system.accumulate(frame_step, shared_step, random(FRAMES, 6), random(FRAMES, 6).abs() + 0.1)
    system.next_frame_coupling[:-1] = 0.3
    system.second_next_frame_coupling[:-2] = -0.2
    total = FRAMES * PARAMETERS
    dense = np.zeros((total + shared, total + shared))
    for frame in range(FRAMES):
        span = slice(frame * PARAMETERS, (frame + 1) * PARAMETERS)
        dense[span, span] = system.frame_hessian[frame].numpy()
        dense[span, total:] = system.border[frame].numpy()
        for ahead, coupling in ((1, system.next_frame_coupling), (2, system.second_next_frame_coupling)):
            if frame + ahead < FRAMES:
                other = slice((frame + ahead) * PARAMETERS, (frame + ahead + 1) * PARAMETERS)
                dense[other, span] = dense[span, other] = np.diag(coupling[frame].numpy())
    dense[total:, :total] = dense[:total, total:].T
    dense[total:, total:] = system.shared_hessian.numpy()
    gradient = np.concatenate([system.frame_gradient.flatten().numpy(), system.shared_gradient.numpy()])
    return system, dense, gradient


@pytest.mark.parametrize("shared", [0, SHARED])
def test_step_solves_the_damped_dense_system(shared: int) -> None:
    system, dense, gradient = random_system(shared)
    damped = dense + 0.1 * np.diag(np.diag(dense))
    expected = -np.linalg.solve(damped, gradient)
    frame_step, shared_step = solve(system, 0.1)
    assert np.allclose(np.concatenate([frame_step.flatten().numpy(), shared_step.numpy()]), expected, atol=1e-7)


def test_covariance_is_the_corner_of_the_dense_inverse() -> None:
    system, dense, _ = random_system()
    assert np.allclose(shared_covariance(system), np.linalg.inv(dense)[-SHARED:, -SHARED:], atol=1e-7)


def test_fixed_parameters_have_zero_step() -> None:
    system, _, _ = random_system()
    system.fix_parameters(torch.tensor([True, False]))
    _, shared_step = solve(system, 0.0)
    assert shared_step[1] == 0.0
    assert shared_step[0] != 0.0


def test_minimise_solves_the_rosenbrock_problem() -> None:
    """Rosenbrock's function, residuals (10 (y - x^2), 1 - x), minimum at (1, 1)."""

    def evaluate(state: torch.Tensor) -> NormalEquations:
        x, y = state[0, 0], state[0, 1]
        system = NormalEquations.zeros(1, 2, 0)
        residual = torch.stack([10 * (y - x**2), 1 - x])[None]
        frame_step = torch.tensor([[[-20 * x, 10.0], [-1.0, 0.0]]], dtype=torch.float64)
        system.accumulate(frame_step, torch.zeros(1, 2, 0, dtype=torch.float64), residual, torch.ones_like(residual))
        system.cost = float(residual.square().sum())
        return system

    start = torch.tensor([[-1.2, 1.0]], dtype=torch.float64)
    state, system = minimise(start, evaluate, lambda state, frame_step, _: state + frame_step, 100, tolerance=1e-12)
    assert torch.allclose(state, torch.ones(1, 2, dtype=torch.float64), atol=1e-4)
    assert system.cost < 1e-6
