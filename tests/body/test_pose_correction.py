import numpy as np
import pytest
import torch

from pipeline.body.body import canonical_to_world, load_anny
from pipeline.body.pose_correction import (
    TYPICAL_CORRELATION_TIME_S,
    PoseCorrection,
    corrections_between,
    correlation_time_s,
    interpolate_corrections,
)
from tests.field.scene import make_motion


@pytest.fixture(scope="module")
def body():
    anny = load_anny()
    return anny.at_shape(anny.shape_defaults)


@pytest.fixture
def correction(body):
    return PoseCorrection(body, make_motion(body, 6).select(np.array([0, 2, 3, 5])))


def test_zero_correction_keeps_the_fitted_motion(body, correction):
    rows = torch.tensor([0, 3])
    truth = canonical_to_world(body, correction.motion)[rows]
    torch.testing.assert_close(correction.canonical_to_world(rows), truth, atol=1e-5, rtol=0)
    assert float(correction.temporal_roughness().detach()) == 0
    assert float(correction.mean_square_correction().detach()) == 0


def test_applied_corrections_equal_the_optimised_ones(body, correction):
    with torch.no_grad():
        correction.rotation_rad.normal_(std=0.05)
        correction.shift_m.normal_(std=0.01)
    again = canonical_to_world(body, correction.apply(correction.motion))
    optimised = correction.canonical_to_world(torch.arange(4)).detach()
    torch.testing.assert_close(again, optimised, atol=1e-5, rtol=0)


def test_averages_over_time_have_the_weights_of_an_exponential(correction):
    """Frames 0, 2, 3, 5 of 30 a second; the weight falls to 1 / e in a tenth of a second, which is three frames."""
    weights = correction.averaging_weights(0.1)
    torch.testing.assert_close(weights.sum(1), torch.ones(4))
    torch.testing.assert_close(weights[0] / weights[0, 0], torch.exp(-torch.tensor([0.0, 2.0, 3.0, 5.0]) / 3.0))
    torch.testing.assert_close(correction.averaging_weights(0.0), torch.eye(4))


def test_corrections_between_two_motions_are_those_that_were_applied(body, correction):
    with torch.no_grad():
        correction.rotation_rad.normal_(std=0.05)
        correction.shift_m.normal_(std=0.01)
    found = corrections_between(body, correction.motion, correction.apply(correction.motion))
    expected = torch.cat([correction.rotation_rad.flatten(1), correction.shift_m], dim=1).detach()
    assert found.shape == (4, correction.size)
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_corrections_reach_the_frames_between_and_no_others(body, correction):
    """Frames 0, 2, 3, 5 are learnt from; the correlation of successive corrections gives the correlation time."""
    with torch.no_grad():
        correction.shift_m[:, 0] = torch.tensor([0.02, 0.04, 0.01, 0.02])
    motion = make_motion(body, 40)
    shift = correction.apply(motion).root_translation_m - motion.root_translation_m
    correlation = (0.02 * 0.04 + 0.04 * 0.01 + 0.01 * 0.02) / (0.02**2 + 0.04**2 + 0.01**2)
    decay = correlation ** (1 / np.mean([2, 1, 2]))
    np.testing.assert_allclose(shift[[0, 2, 3, 5], 0], [0.02, 0.04, 0.01, 0.02], atol=1e-6)
    np.testing.assert_allclose(shift[1, 0], 0.06 * decay / (1 + decay**2), atol=1e-6)
    np.testing.assert_allclose(shift[5:10, 0], 0.02 * decay ** np.arange(5), atol=1e-6)
    assert abs(shift[30:]).max() < 1e-3
    np.testing.assert_allclose(shift[:, 1:], 0.0, atol=1e-7)


def test_interpolated_corrections_are_the_kriging_mean():
    """Independent truth: the dense solution of Gaussian process regression."""
    random = np.random.default_rng(0)
    known_s = np.cumsum(random.uniform(0.02, 0.2, 12))
    wanted_s = np.sort(np.concatenate([known_s[[0, 5, -1]], random.uniform(-1.0, known_s[-1] + 1.0, 40)]))
    corrections = random.normal(size=(12, 4))
    scale_s = correlation_time_s(known_s, corrections)
    covariance = np.exp(-abs(known_s[:, None] - known_s) / scale_s)
    truth = np.exp(-abs(wanted_s[:, None] - known_s) / scale_s) @ np.linalg.solve(covariance, corrections)
    np.testing.assert_allclose(interpolate_corrections(wanted_s, known_s, corrections), truth, atol=1e-6)


def test_corrections_of_a_short_gap_are_interpolated_linearly():
    known_s, corrections = np.array([0.0, 0.04, 0.08, 0.12]), np.array([[1.0], [1.1], [1.2], [1.3]])
    found = interpolate_corrections(np.array([0.01, 0.06]), known_s, corrections)
    np.testing.assert_allclose(found[:, 0], [1.025, 1.15], atol=0.005)


@pytest.mark.parametrize("true_s", [0.1, 0.3])
def test_correlation_time_of_a_known_process(true_s):
    """Ornstein-Uhlenbeck processes at uneven times; every eighth frame is missing."""
    random, time_s = np.random.default_rng(1), np.delete(np.arange(400) / 25, np.arange(0, 400, 8))
    decay = np.exp(-np.diff(time_s) / true_s)[:, None]
    values = [random.normal(size=60)]
    for factor in decay:
        values.append(factor * values[-1] + np.sqrt(1 - factor**2) * random.normal(size=60))
    assert correlation_time_s(time_s, np.stack(values)) == pytest.approx(true_s, rel=0.05)


def test_correlation_time_without_evidence():
    time_s = np.arange(4) / 25
    assert correlation_time_s(time_s[:1], np.ones((1, 3))) == TYPICAL_CORRELATION_TIME_S
    assert correlation_time_s(time_s, np.zeros((4, 3))) == pytest.approx(0.004)
    assert correlation_time_s(time_s, np.ones((4, 3))) == pytest.approx(0.4)
    assert np.isfinite(interpolate_corrections(np.linspace(-9, 9, 50), time_s, np.zeros((4, 3)))).all()


def test_roughness_grows_with_jumps_and_falls_with_the_interval(body, correction):
    with torch.no_grad():
        correction.shift_m[2:] = 0.01
    near = float(correction.temporal_roughness().detach())
    with torch.no_grad():
        correction.shift_m[2] = 0.0
    # The jump is now between frames 3 and 5, which are twice as far apart as frames 2 and 3.
    assert float(correction.temporal_roughness().detach()) == pytest.approx(near / 2, rel=1e-5)


@pytest.mark.parametrize("size", [0.0, 3e-3, 0.4, 2.5])
def test_compiled_kinematics_equals_the_reference(body, correction, size):
    """Values and gradients, against float64; small corrections use the series of Rodrigues' factors."""
    random = torch.Generator().manual_seed(1)
    rows, motion = torch.tensor([2, 0, 3]), correction.motion
    shape = correction.rotation_rad.shape
    with torch.no_grad():
        correction.rotation_rad.copy_(
            size * torch.nn.functional.normalize(torch.randn(shape, generator=random), dim=-1)
        )
        correction.shift_m.normal_(std=0.05, generator=random)
    rigid = canonical_to_world(body, motion)[rows, 5].inverse().contiguous()
    ours = correction.canonical_to_posed(rows, rigid)
    twin = rigid[:, None] @ correction.canonical_to_world(rows)
    torch.testing.assert_close(ours, twin, atol=2e-6, rtol=0)
    weights = torch.randn(ours.shape, generator=random)
    found, truth = (
        torch.autograd.grad((matrices * weights).sum(), (correction.rotation_rad, correction.shift_m))
        for matrices in (ours, twin)
    )
    for mine, theirs in zip(found, truth, strict=True):
        assert not mine[1].any()
        torch.testing.assert_close(mine, theirs, atol=3e-5 * float(theirs.abs().max()), rtol=0)
