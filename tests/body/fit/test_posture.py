"""Posture of a recording, against values of known mean and spread."""

import pytest
import torch

from pipeline.body.body import load_anny
from pipeline.body.fit.linear_body import ACTIVE_JOINTS, linearise_body
from pipeline.body.fit.prior.posture import (
    MIN_SPREAD_RAD,
    MIN_STILL_SPREAD_RAD,
    STILL_SLACK,
    estimate_posture,
    frames_per_posture,
    most_likely_posture,
    prior_of_recording,
    tie_still_joints,
    tie_to_posture,
)
from pipeline.body.fit.prior.priors import PosePrior, pose_prior, tilt_of_hips
from pipeline.geometry.rotation import axis_angle_to_matrix

FRAMES = 400
TIME_S = torch.arange(FRAMES, dtype=torch.float64) / 10.0
ARM, SPINE = ACTIVE_JOINTS.index("LeftArm"), ACTIVE_JOINTS.index("Spine")


@pytest.fixture(scope="module")
def prior() -> PosePrior:
    body = load_anny()
    return pose_prior(linearise_body(body, body.shape_defaults))


def noise(*shape: int, seed: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("spread_rad", [0.05, 0.2, 0.6])
def test_spread_is_separated_from_errors(spread_rad: float) -> None:
    """Values of known spread about 0.4, observed with errors of 0.02 in every fifth frame and of 0.5 in the others."""
    std = torch.where(torch.arange(FRAMES) % 5 == 0, 0.02, 0.5).double()[:, None]
    value = 0.4 + spread_rad * noise(FRAMES, 1, seed=0) + std * noise(FRAMES, 1, seed=1)
    posture = most_likely_posture(value, std**2)
    assert float(posture.mean_rad) == pytest.approx(0.4, abs=3.0 * spread_rad / (FRAMES / 5) ** 0.5)
    assert float(posture.spread_rad) == pytest.approx(spread_rad, rel=0.3)


def test_errors_alone_have_no_spread() -> None:
    std = torch.full((FRAMES, 1), 0.3, dtype=torch.float64)
    posture = most_likely_posture(0.4 + 0.1 * noise(FRAMES, 1, seed=2), std**2)
    assert float(posture.mean_rad) == pytest.approx(0.4, abs=0.02)
    assert float(posture.spread_rad) == pytest.approx(MIN_SPREAD_RAD)


def turning_person() -> torch.Tensor:
    """Return the angles of a person who turns once and holds the A-pose."""
    angles = torch.zeros(FRAMES, len(ACTIVE_JOINTS), 3, dtype=torch.float64)
    angles[:, 0, 1] = torch.linspace(-3.0, 3.0, FRAMES, dtype=torch.float64)
    return angles


def posture_of(prior: PosePrior, angles: torch.Tensor, std_rad: torch.Tensor) -> PosePrior:
    """Return the prior of a recording with these angles, whose image leaves these standard deviations."""
    hessian = torch.diag_embed(std_rad**-2)
    posture = estimate_posture(prior, axis_angle_to_matrix(angles), TIME_S, hessian)
    assert posture is not None
    return tie_to_posture(prior, posture, TIME_S)


def test_frames_that_show_an_angle_decide_its_mean(prior: PosePrior) -> None:
    """An arm looks swung by 0.5 rad in frames that hardly show it, and is at 0.1 in those that do."""
    joints, shows = len(ACTIVE_JOINTS), torch.arange(FRAMES) % 4 == 0
    angles = turning_person()
    angles[:, ARM, 0] = torch.where(shows, 0.1, 0.5).double() + 0.01 * noise(FRAMES, seed=3)
    std = torch.full((FRAMES, 3 * joints + 3), 0.02, dtype=torch.float64)
    std[~shows, 3 * ARM] = 3.0
    tied = posture_of(prior, angles, std)
    assert float(tied.mean_rad[ARM, 0]) == pytest.approx(0.1, abs=0.01)
    assert float(tied.std_rad[ARM, 0]) == pytest.approx(MIN_SPREAD_RAD * frames_per_posture(TIME_S) ** 0.5)
    assert torch.equal(tied.std_rad[SPINE], prior.std_rad[SPINE])  # a tight prior of anyone stays


def test_whoever_is_filmed_from_one_side_is_not_tied(prior: PosePrior) -> None:
    angles = turning_person()
    angles[:, 0, 1] *= 0.3
    hessian = torch.eye(3 * len(ACTIVE_JOINTS) + 3, dtype=torch.float64).expand(FRAMES, -1, -1)
    assert estimate_posture(prior, axis_angle_to_matrix(angles), TIME_S, hessian) is None


def test_still_joints_are_tied_to_their_mean(prior: PosePrior) -> None:
    """An arm with little motion is tied to its mean; a swinging leg and the spine keep the general prior."""
    arm, leg, spine = (ACTIVE_JOINTS.index(name) for name in ("LeftArm", "LeftUpLeg", "Spine"))
    phase = torch.linspace(0.0, 6.0, 200, dtype=torch.float64)
    angles = torch.zeros(200, len(ACTIVE_JOINTS), 3, dtype=torch.float64)
    angles[:, arm, 2] = 0.9 + 0.05 * torch.sin(phase)
    angles[:, leg, 0] = 0.5 * torch.sin(phase)
    tied = tie_still_joints(prior, axis_angle_to_matrix(angles))
    spread = float(angles[:, arm, 2].var(correction=0))
    assert tied.mean_rad[arm, 2] == pytest.approx(float(angles[:, arm, 2].mean()))
    assert tied.std_rad[arm, 2] == pytest.approx(STILL_SLACK * (spread + MIN_STILL_SPREAD_RAD**2) ** 0.5)
    assert tied.mean_rad[leg, 0] == 0.0
    assert tied.std_rad[leg, 0] == prior.std_rad[leg, 0]
    assert torch.equal(tied.std_rad[spine], prior.std_rad[spine])


def test_a_hidden_angle_moves_as_much_as_the_others(prior: PosePrior) -> None:
    """The forearm looks still and the image hardly shows it; all other angles of the limbs spread by 0.2 rad."""
    joints, forearm = len(ACTIVE_JOINTS), ACTIVE_JOINTS.index("LeftForeArm")
    angles = turning_person()
    angles[:, 1:] = 0.2 * noise(FRAMES, joints - 1, 3, seed=6)
    angles[:, forearm] = 0.0
    std = torch.full((FRAMES, 3 * joints + 3), 0.02, dtype=torch.float64)
    std[:, 3 * forearm : 3 * forearm + 3] = 2.0
    tied = posture_of(prior, angles, std)
    assert float(tied.std_rad[forearm, 1]) == pytest.approx(0.2 * frames_per_posture(TIME_S) ** 0.5, rel=0.15)


def test_a_dancer_is_not_tied(prior: PosePrior) -> None:
    angles = turning_person()
    angles[:, ARM] = 0.6 * noise(FRAMES, 3, seed=4)
    tied = posture_of(prior, angles, torch.full((FRAMES, 3 * len(ACTIVE_JOINTS) + 3), 0.05).double())
    assert torch.equal(tied.std_rad[ARM], prior.std_rad[ARM])
    assert torch.equal(tied.mean_rad[ARM], prior.mean_rad[ARM])


def test_frames_of_half_a_second_share_their_evidence(prior: PosePrior) -> None:
    """Five frames tell an angle five times as exactly as one, so a scatter as large as one frame's error is motion."""
    angles, std_rad, frames = turning_person(), 0.15, frames_per_posture(TIME_S)
    angles[:, ARM] = std_rad * noise(FRAMES, 3, seed=7)
    tied = posture_of(prior, angles, torch.full((FRAMES, 3 * len(ACTIVE_JOINTS) + 3), std_rad).double())
    expected = std_rad * (1.0 - 1.0 / frames) ** 0.5 * frames**0.5
    assert float(tied.std_rad[ARM, 0]) == pytest.approx(expected, rel=0.15)


def test_whoever_leans_is_tied_to_the_lean(prior: PosePrior) -> None:
    lean = axis_angle_to_matrix(torch.tensor([0.2, 0.0, 0.0], dtype=torch.float64))
    rotations = axis_angle_to_matrix(turning_person())
    rotations[:, 0] = rotations[:, 0] @ lean
    hessian = (0.02**-2 * torch.eye(3 * len(ACTIVE_JOINTS) + 3, dtype=torch.float64)).expand(FRAMES, -1, -1)
    posture = estimate_posture(prior, rotations, TIME_S, hessian)
    assert posture is not None
    expected, _ = tilt_of_hips(rotations[:1, 0])
    torch.testing.assert_close(tie_to_posture(prior, posture, TIME_S).tilt_mean, expected[0], atol=0.01, rtol=0.0)


def test_without_a_posture_still_joints_are_tied(prior: PosePrior) -> None:
    rotations = axis_angle_to_matrix(turning_person())
    expected = tie_still_joints(prior, rotations)
    assert not torch.equal(expected.std_rad, prior.std_rad)
    assert torch.equal(prior_of_recording(prior, None, rotations, TIME_S).std_rad, expected.std_rad)


def test_frames_of_half_a_second_count_once() -> None:
    """A posture ties ten frames a second as much as fifty."""
    assert frames_per_posture(torch.arange(100) / 10.0) == pytest.approx(5.0)
    assert frames_per_posture(torch.arange(100) / 50.0) == pytest.approx(25.0)
    assert frames_per_posture(torch.arange(100).double()) == 1.0
    assert frames_per_posture(torch.zeros(1)) == 1.0


def test_tilt_of_the_hips_whatever_way_they_face() -> None:
    """Whoever leans forwards by 0.2 rad and turns has a constant tilt; the derivative is that of finite differences."""
    yaw = torch.linspace(0.0, 6.0, 50, dtype=torch.float64)
    turn = axis_angle_to_matrix(torch.stack([0.0 * yaw, yaw, 0.0 * yaw], dim=-1))
    lean = axis_angle_to_matrix(torch.tensor([0.2, 0.0, 0.0], dtype=torch.float64))
    tilt, jacobian = tilt_of_hips(turn @ lean)
    expected = torch.tensor([0.0, -torch.sin(torch.tensor(0.2))], dtype=torch.float64).expand(50, 2)
    torch.testing.assert_close(tilt, expected)
    step = 1e-6 * noise(3, seed=5)
    moved, _ = tilt_of_hips(axis_angle_to_matrix(step) @ turn @ lean)
    torch.testing.assert_close((moved - tilt) / 1e-6, (jacobian @ step[:, None])[..., 0] / 1e-6, atol=1e-5, rtol=1e-4)
