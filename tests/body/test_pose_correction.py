import numpy as np
import pytest
import torch

from pipeline.body.body import canonical_to_world, load_anny
from pipeline.body.pose_correction import PoseCorrection
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


def test_corrections_are_interpolated(body, correction):
    with torch.no_grad():
        correction.shift_m[0, 0], correction.shift_m[1, 0] = 0.02, 0.04
    motion = make_motion(body, 6)
    shift = correction.apply(motion).root_translation_m - motion.root_translation_m
    np.testing.assert_allclose(shift[:3, 0], [0.02, 0.03, 0.04], atol=1e-6)
    np.testing.assert_allclose(shift[5, 0], 0.0, atol=1e-6)


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
