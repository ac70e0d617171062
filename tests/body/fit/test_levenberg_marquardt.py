import numpy as np
import pytest
import torch

from pipeline.body.fit.levenberg_marquardt import NormalEquations, minimise, shared_covariance, solve

FRAMES, NUMBERS, SHARED = 5, 3, 2


def random_system(shared: int = SHARED) -> tuple[NormalEquations, np.ndarray, np.ndarray]:
    """Normal equations in blocks, and the same as one dense matrix and gradient."""
    generator = torch.Generator().manual_seed(3)

    def random(*size: int) -> torch.Tensor:
        return torch.randn(*size, generator=generator, dtype=torch.float64)

    system = NormalEquations.zeros(FRAMES, NUMBERS, shared)
    for _ in range(2):
        by_frame, by_shared = random(FRAMES, 6, NUMBERS), random(FRAMES, 6, shared)
        system.add(by_frame, by_shared, random(FRAMES, 6), random(FRAMES, 6).abs() + 0.1)
    system.next_frame_coupling[:-1] = 0.3
    system.second_next_frame_coupling[:-2] = -0.2
    total = FRAMES * NUMBERS
    dense = np.zeros((total + shared, total + shared))
    for frame in range(FRAMES):
        span = slice(frame * NUMBERS, (frame + 1) * NUMBERS)
        dense[span, span] = system.frame[frame].numpy()
        dense[span, total:] = system.border[frame].numpy()
        for ahead, coupling in ((1, system.next_frame_coupling), (2, system.second_next_frame_coupling)):
            if frame + ahead < FRAMES:
                other = slice((frame + ahead) * NUMBERS, (frame + ahead + 1) * NUMBERS)
                dense[other, span] = dense[span, other] = np.diag(coupling[frame].numpy())
    dense[total:, :total] = dense[:total, total:].T
    dense[total:, total:] = system.shared.numpy()
    gradient = np.concatenate([system.frame_gradient.flatten().numpy(), system.shared_gradient.numpy()])
    return system, dense, gradient


@pytest.mark.parametrize("shared", [0, SHARED])
def test_step_solves_the_damped_dense_system(shared: int) -> None:
    system, dense, gradient = random_system(shared)
    damped = dense + 0.1 * np.diag(np.diag(dense))
    expected = -np.linalg.solve(damped, gradient)
    by_frame, by_shared = solve(system, 0.1)
    assert np.allclose(np.concatenate([by_frame.flatten().numpy(), by_shared.numpy()]), expected, atol=1e-7)


def test_covariance_is_the_corner_of_the_dense_inverse() -> None:
    system, dense, _ = random_system()
    assert np.allclose(shared_covariance(system), np.linalg.inv(dense)[-SHARED:, -SHARED:], atol=1e-7)


def test_frozen_numbers_do_not_move() -> None:
    system, _, _ = random_system()
    system.fix_parameters(torch.tensor([True, False]))
    _, by_shared = solve(system, 0.0)
    assert by_shared[1] == 0.0
    assert by_shared[0] != 0.0


def test_minimise_finds_the_bottom_of_a_curved_valley() -> None:
    """Rosenbrock's function, residuals (10 (y - x^2), 1 - x), minimum at (1, 1)."""

    def evaluate(state: torch.Tensor) -> NormalEquations:
        x, y = state[0, 0], state[0, 1]
        system = NormalEquations.zeros(1, 2, 0)
        residual = torch.stack([10 * (y - x**2), 1 - x])[None]
        by_frame = torch.tensor([[[-20 * x, 10.0], [-1.0, 0.0]]], dtype=torch.float64)
        system.add(by_frame, torch.zeros(1, 2, 0, dtype=torch.float64), residual, torch.ones_like(residual))
        system.cost = float(residual.square().sum())
        return system

    start = torch.tensor([[-1.2, 1.0]], dtype=torch.float64)
    state, system = minimise(start, evaluate, lambda state, by_frame, _: state + by_frame, 100, tolerance=1e-12)
    assert torch.allclose(state, torch.ones(1, 2, dtype=torch.float64), atol=1e-4)
    assert system.cost < 1e-6
