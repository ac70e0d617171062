"""Clothes in the fit: harmonics of the surface, and a fit to masks of thick clothes."""

from dataclasses import replace
from functools import partial

import igl
import numpy as np
import pytest
import torch

from pipeline.body.body import load_anny
from pipeline.body.fit.fit import fit_body
from pipeline.body.fit.linear_body import ACTIVE_JOINTS, LinearBody, linearise_body
from pipeline.body.fit.options import FitOptions
from pipeline.body.fit.prior.clothing import (
    BARE_JOINTS,
    HARMONICS,
    OFFSET_STD_M,
    clothing_offsets,
    dress,
    fill_clothes,
    with_clothing,
)
from pipeline.body.fit.prior.priors import shape_prior
from tests.body.acting import fitted_joints_m, joint_errors_m, synthetic_recording

FRAMES = 24


@pytest.fixture(scope="module")
def model() -> LinearBody:
    return linearise_body(load_anny(), load_anny().shape_defaults)


@pytest.fixture(scope="module")
def offsets_m(model: LinearBody) -> torch.Tensor:
    return clothing_offsets(model)


def vertex_normals(model: LinearBody) -> torch.Tensor:
    return torch.from_numpy(igl.per_vertex_normals(model.vertices_m.numpy(), model.faces.long().numpy()))


def test_harmonics_are_orthogonal_and_have_the_variance_of_the_prior(
    model: LinearBody, offsets_m: torch.Tensor
) -> None:
    area = igl.massmatrix(model.vertices_m.numpy(), model.faces.long().numpy(), igl.MASSMATRIX_TYPE_VORONOI).diagonal()
    along_normal = (offsets_m * vertex_normals(model)[:, :, None]).sum(1).numpy()
    np.testing.assert_allclose(np.linalg.norm(along_normal), np.linalg.norm(offsets_m.numpy()), rtol=1e-9)
    products = along_normal.T @ (area[:, None] * along_normal)
    variances = np.diag(products)
    np.testing.assert_allclose(products, np.diag(variances), atol=1e-9 * variances.max())
    dressed_area = area[np.abs(along_normal).sum(1) > 0].sum()
    np.testing.assert_allclose(variances.sum() / dressed_area, OFFSET_STD_M**2, rtol=1e-9)
    assert variances[0] > 10 * variances[-1]


def test_heads_hands_and_feet_are_bare(model: LinearBody, offsets_m: torch.Tensor) -> None:
    bare = model.skin_weights[:, [ACTIVE_JOINTS.index(name) for name in BARE_JOINTS]].sum(1) > 0.5
    assert offsets_m[bare].count_nonzero() == 0
    chest = model.skin_weights[:, ACTIVE_JOINTS.index("Spine1")] > 0.5
    assert (offsets_m[chest].square().sum((1, 2)).sqrt() > 0.005).all()


def test_the_same_body_gives_the_same_bits(model: LinearBody, offsets_m: torch.Tensor) -> None:
    assert torch.equal(clothing_offsets(model), offsets_m)


def test_clothes_move_the_surface_and_no_joint(model: LinearBody, offsets_m: torch.Tensor) -> None:
    clothing = torch.randn(HARMONICS, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    dressed = dress(model, offsets_m, clothing)
    torch.testing.assert_close(dressed.vertices_m - model.vertices_m, (offsets_m * clothing).sum(2))
    assert torch.equal(dressed.joints_m, model.joints_m)
    step = torch.zeros_like(dressed.shape)
    step[0], step[-3] = 0.1, 1.0
    stepped = dressed.at_shape(dressed.shape + step)
    expected_m = model.vertices_shape_jacobian[:, :, 0] * 0.1 + offsets_m[:, :, -3]
    torch.testing.assert_close(stepped.vertices_m - dressed.vertices_m, expected_m)
    torch.testing.assert_close(stepped.joints_m - model.joints_m, model.joints_shape_jacobian[:, :, 0] * 0.1)


def test_the_prior_of_the_body_stays(model: LinearBody) -> None:
    bare = shape_prior(load_anny().shape_names, load_anny().shape_defaults)
    clothed = with_clothing(bare, 2)
    for name, value in vars(bare).items():
        assert torch.equal(getattr(clothed, name)[:-2], value)
    assert clothed.std[-2:].tolist() == [1.0, 1.0]
    assert clothed.mean[-2:].tolist() == [0.0, 0.0]


def test_a_body_that_fills_a_body_is_that_body(model: LinearBody) -> None:
    body = load_anny()
    true = torch.tensor(
        [
            {"waist-girth": 0.5, "weight": 0.7}.get(name, float(value))
            for name, value in zip(body.shape_names, body.shape_defaults, strict=True)
        ]
    ).double()
    prior = shape_prior(body.shape_names, body.shape_defaults)
    target = linearise_body(body, true)
    found = fill_clothes(target, body.shape_defaults.double(), prior, partial(linearise_body, body))
    filled = linearise_body(body, found)
    before_m = (model.vertices_m - target.vertices_m).norm(dim=1).mean()
    after_m = (filled.vertices_m - target.vertices_m).norm(dim=1).mean()
    joints_m = (filled.joints_m - target.joints_m).norm(dim=1).max()
    print(f"surface {1000 * before_m:.1f} -> {1000 * after_m:.2f} mm, joints {1000 * joints_m:.2f} mm")
    assert after_m < 0.1 * before_m
    assert joints_m < 0.002


def test_thick_clothes_do_not_move_the_joints() -> None:
    """A person who turns once; clothes of trunk and legs, in the masks alone, are 4 cm thick."""
    scene = synthetic_recording(load_anny(), FRAMES, noise_m=0.008)
    covered = ("Hips", "Spine", "Spine1", "Spine2", "LeftUpLeg", "RightUpLeg", "LeftLeg", "RightLeg")
    thickness_m = 0.04 * scene.model.skin_weights[:, [ACTIVE_JOINTS.index(name) for name in covered]].sum(1)
    vertices_m = scene.model.vertices_m + thickness_m[:, None] * vertex_normals(scene.model)
    dressed = replace(scene, model=replace(scene.model, vertices_m=vertices_m))
    options = FitOptions(scene.model.height_m()[0], 0.0, shared_frames=FRAMES, rounds=6)
    result = fit_body(load_anny(), scene.observations(scene.camera), dressed.windows(), options)
    aligned_m, absolute_m = joint_errors_m(fitted_joints_m(result, scene), scene.joints_m())
    print(f"joints {1000 * aligned_m:.1f} and {1000 * absolute_m:.1f} mm, iou {result.silhouette_iou.mean():.3f}")
    assert aligned_m < 0.020  # the bare body: 0.035
    thighs = scene.model.skin_weights[:, [ACTIVE_JOINTS.index("LeftUpLeg"), ACTIVE_JOINTS.index("RightUpLeg")]]
    surface_m = torch.from_numpy(result.body.vertices).double() - dressed.model.vertices_m
    distance_m = surface_m[thighs.sum(1) > 0.9].norm(dim=1).median()
    print(f"thighs {1000 * distance_m:.1f} mm")
    assert distance_m < 0.025  # below the clothes: 0.036
    assert result.silhouette_iou.mean() > 0.97
    height_m = float(np.ptp(result.body.vertices[:, 1]))
    assert height_m == pytest.approx(scene.model.height_m()[0], abs=0.01)
