import numpy as np
import pytest
import torch

from pipeline.body.body import load_anny
from pipeline.body.fit.linear_body import ACTIVE_JOINTS, linearise_body
from pipeline.body.fit.prior.priors import (
    MIN_MOTION_RATIO,
    REFERENCE_INTERVAL_S,
    PosePrior,
    default_motion_std,
    estimate_motion_std,
    inverse_left_jacobian_so3,
    motion_residuals,
    pose_prior,
    pose_residuals,
    rotation_to_axis_angle,
    shape_prior,
    skew_symmetric,
    tilt_of_hips,
)
from pipeline.geometry.rotation import axis_angle_to_matrix


@pytest.fixture(scope="module")
def prior() -> PosePrior:
    body = load_anny()
    return pose_prior(linearise_body(body, body.shape_defaults))


def bent(joint: str, axis_angle: torch.Tensor) -> torch.Tensor:
    angles = torch.zeros(1, len(ACTIVE_JOINTS), 3, dtype=torch.float64)
    angles[0, ACTIVE_JOINTS.index(joint)] = axis_angle
    return axis_angle_to_matrix(angles)


def test_cross_matrix_is_the_cross_product() -> None:
    a, b = torch.randn(2, 4, 3, dtype=torch.float64)
    assert torch.allclose((skew_symmetric(a) @ b[..., None])[..., 0], torch.linalg.cross(a, b))


@pytest.mark.parametrize("size", [0.0, 1e-3, 0.7, 2.5])
def test_logarithm_jacobian_agrees_with_differences(size: float) -> None:
    vector = size * torch.nn.functional.normalize(torch.tensor([0.3, -0.5, 0.8], dtype=torch.float64), dim=0)
    columns = []
    for axis in torch.eye(3, dtype=torch.float64):
        forward = rotation_to_axis_angle(axis_angle_to_matrix(1e-5 * axis) @ axis_angle_to_matrix(vector))
        backward = rotation_to_axis_angle(axis_angle_to_matrix(-1e-5 * axis) @ axis_angle_to_matrix(vector))
        columns.append((forward - backward) / 2e-5)
    assert torch.allclose(inverse_left_jacobian_so3(vector), torch.stack(columns, dim=1), atol=1e-5)


def test_pose_derivative_agrees_with_differences(prior: PosePrior) -> None:
    generator = torch.Generator().manual_seed(0)
    angles = 0.5 * torch.randn(2, len(ACTIVE_JOINTS), 3, generator=generator, dtype=torch.float64)
    step = 1e-6 * torch.randn(angles.shape, generator=generator, dtype=torch.float64)
    rotations = axis_angle_to_matrix(angles)
    residual, derivative = pose_residuals(prior, rotations)
    moved, _ = pose_residuals(prior, axis_angle_to_matrix(step) @ rotations)
    assert torch.allclose((derivative @ step[..., None])[..., 0], moved - residual, atol=1e-8)


@pytest.mark.parametrize("yaw", [0.0, 2.0])
def test_people_stand_upright_unless_they_are_seen_to_bend(prior: PosePrior, yaw: float) -> None:
    """Bent by 20 degrees they are about one standard deviation off, so that images decide; turning costs nothing."""
    turn = axis_angle_to_matrix(torch.tensor([[0.0, yaw, 0.0]], dtype=torch.float64))
    bend = axis_angle_to_matrix(torch.tensor([[np.radians(20.0), 0.0, 0.0]], dtype=torch.float64))
    upright, bent_over = ((tilt_of_hips(pose)[0] - prior.tilt_mean) / prior.tilt_std for pose in (turn, turn @ bend))
    assert upright.norm() < 1e-9
    assert bent_over.norm() == pytest.approx(1.14, abs=0.01)


def test_knees_flex_backward_only(prior: PosePrior) -> None:
    """A positive rotation about +X moves the foot backward; a negative one exceeds the limit."""
    backward, _ = pose_residuals(prior, bent("LeftLeg", torch.tensor([1.5, 0.0, 0.0])))
    forward, _ = pose_residuals(prior, bent("LeftLeg", torch.tensor([-0.6, 0.0, 0.0])))
    assert backward[0, :, 3:].abs().max() == 0.0
    assert forward[0, ACTIVE_JOINTS.index("LeftLeg"), 3:].abs().max() > 5.0


@pytest.mark.parametrize("side", ["Left", "Right"])
def test_elbows_flex_forward_only(prior: PosePrior, side: str) -> None:
    joint = ACTIVE_JOINTS.index(f"{side}ForeArm")
    body = load_anny()
    model = linearise_body(body, body.shape_defaults)
    flexion = prior.axes[joint, 1]
    hand = model.joints_m[ACTIVE_JOINTS.index(f"{side}Hand")] - model.joints_m[joint]
    assert (axis_angle_to_matrix(0.8 * flexion) @ hand - hand)[2] > 0.05
    bending, _ = pose_residuals(prior, bent(f"{side}ForeArm", 1.0 * flexion))
    breaking, _ = pose_residuals(prior, bent(f"{side}ForeArm", -1.3 * flexion))
    assert bending[0, joint, 3:].abs().max() == 0.0
    assert breaking[0, joint, 3:].abs().max() > 3.0


def test_uniform_motion_has_zero_residual_at_any_interval() -> None:
    time_s = torch.tensor([0.0, 0.1, 0.13, 0.4, 0.5], dtype=torch.float64)
    turn = torch.tensor([0.2, 1.5, -0.4], dtype=torch.float64)
    rotations = axis_angle_to_matrix((time_s[:, None] * turn)[:, None].expand(-1, 3, -1))
    root = time_s[:, None] * torch.tensor([0.3, 0.0, -1.0], dtype=torch.float64)
    steady = motion_residuals(rotations, root, time_s)
    assert steady.abs().max() < 1e-9
    root[2, 0] += 0.05
    assert motion_residuals(rotations, root, time_s).abs().max() > 0.03


def test_shape_prior_separates_phenotypes_from_local_changes() -> None:
    prior = shape_prior(("gender", "waist-girth"), torch.tensor([0.5, 0.0]))
    assert np.allclose(prior.lower_bound, [0.02, -1.0])
    assert np.allclose(prior.mean, [0.5, 0.0])


@pytest.mark.parametrize(("pushed", "expected"), [(0.2, 0.4), (0.0, MIN_MOTION_RATIO), (5.0, 1.0)])
def test_motion_is_separated_from_noise(pushed: float, expected: float) -> None:
    """White noise acceleration of known variance, observed with independent errors in each frame."""
    generator = torch.Generator().manual_seed(3)
    default_std = default_motion_std(1)
    acceleration = pushed * default_std * torch.randn(4000, 6, generator=generator, dtype=torch.float64)
    path = acceleration.cumsum(0).cumsum(0) + 0.1 * default_std * torch.randn(4000, 6, generator=generator).double()
    angles = path[:, :3] * torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    rotations = axis_angle_to_matrix(angles)[:, None]
    time_s = torch.arange(4000, dtype=torch.float64) * REFERENCE_INTERVAL_S
    share = estimate_motion_std(rotations, path[:, 3:], time_s) / default_std
    assert share[3:].tolist() == pytest.approx([expected] * 3, rel=0.3)


def test_a_short_recording_uses_the_default_motion_std() -> None:
    time_s = torch.arange(5, dtype=torch.float64)
    still = torch.eye(3, dtype=torch.float64).repeat(5, 2, 1, 1)
    assert torch.equal(
        estimate_motion_std(still, torch.zeros(5, 3, dtype=torch.float64), time_s), default_motion_std(2)
    )
