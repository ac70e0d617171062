"""What rays see, asked of all samples and only as far as the light goes: two ways to the same picture and gradient."""

from functools import partial

import numpy as np
import pytest
import torch
from torch import Tensor

from pipeline.field import field as field_module
from pipeline.field import volume_rendering as module
from pipeline.field.inverse_skinning import Rays
from pipeline.field.trainer import MAX_SAMPLES_PER_RAY, Trainer
from pipeline.field.volume_rendering import render_rays, render_rays_dense
from pipeline.kernels.hashgrid import FeatureGradients, add_table_gradient_
from pipeline.kernels.volume_rendering import MIN_TRANSMITTANCE, RenderOutput, trace
from tests.field.test_trainer import draw, make_trainer, scene  # noqa: F401 - a fixture


@pytest.fixture(scope="module")
def trainer(scene) -> Trainer:  # noqa: F811
    """A body half learnt: some of it opaque, poses that have moved away from where the warp grids were baked."""
    trainer = make_trainer(scene, steps=160, pose_start_fraction=0.1, occupancy_warmup_steps=8)
    for _ in range(120):
        trainer.step()
    return trainer


def seen(
    trainer: Trainer, way, exact: bool = True, frames: tuple[int, ...] = (1, 4, 6)
) -> tuple[RenderOutput, FeatureGradients]:
    batch, feature_gradients = draw(trainer, *frames), FeatureGradients()
    rays = Rays(batch.origins_m, batch.directions, batch.frame, batch.jitter)
    pose_batch = trainer._pose_batch(batch.frames) if exact else None
    points = torch.tensor([[0.0, 0.9, 0.0], [0.3, 1.2, 0.1], [5.0, 5.0, 5.0]])
    grid = trainer.occupancy.grid()
    found = way(
        trainer.field,
        trainer.inverse,
        grid,
        rays,
        pose_batch,
        points,
        trainer.step_m,
        MAX_SAMPLES_PER_RAY,
        feature_gradients,
    )
    return found, feature_gradients


def gradients(trainer: Trainer, found: RenderOutput, feature_gradients: FeatureGradients) -> dict[str, Tensor]:
    """Of a loss in which every ray, channel and point counts differently."""
    random = torch.Generator().manual_seed(3)
    values = (found.image, found.alpha, 0.01 * found.density_per_m)
    loss = torch.stack([(value * torch.randn(value.shape, generator=random)).sum() for value in values]).sum()
    of = torch.autograd.grad(loss, list(trainer.parameters.values()), allow_unused=True)
    table = torch.zeros_like(trainer.field.table)
    add_table_gradient_(table, feature_gradients, trainer.field.layout)
    named = zip(trainer.parameters, of, strict=True)
    return {"table": table} | {name: value for name, value in named if value is not None}


def whole(subsampling_threshold: float = 0.0):
    """`render_rays` that leaves nothing out."""
    return partial(trace, min_transmittance=0.0, subsampling_threshold=subsampling_threshold)


@pytest.mark.parametrize("exact", [True, False])
def test_both_ways_come_to_the_same(trainer, monkeypatch, exact):
    monkeypatch.setattr(module, "trace", whole())
    monkeypatch.setattr(field_module, "MIN_RELATIVE_GRADIENT", 0.0)
    (ours, feature_gradients), (twin, reference_feature_gradients) = (
        seen(trainer, render_rays, exact),
        seen(trainer, render_rays_dense, exact),
    )
    assert float(twin.alpha.detach().max()) > 0.9
    for name in ("image", "alpha"):
        torch.testing.assert_close(getattr(ours, name), getattr(twin, name), atol=2e-5, rtol=0)
    torch.testing.assert_close(ours.density_per_m, twin.density_per_m, atol=0, rtol=1e-4)
    assert len(ours.transmittance) == len(twin.transmittance) > 5000
    # The order of samples means nothing: compare what they come to.
    for name in ("transmittance", "weight"):
        mine, theirs = (getattr(found, name).double().sort().values for found in (ours, twin))
        torch.testing.assert_close(mine, theirs, atol=2e-5, rtol=0)
    weighted = [(found.canonical_m.double() * found.weight[:, None]).sum(0) for found in (ours, twin)]
    torch.testing.assert_close(*weighted, rtol=1e-5, atol=1e-4)
    mine, theirs = gradients(trainer, ours, feature_gradients), gradients(trainer, twin, reference_feature_gradients)
    assert mine.keys() == theirs.keys()
    assert ("shift_m" in mine) == exact
    for name, gradient in theirs.items():
        # A hidden unit near zero may be on in one and off in the other.
        assert float((mine[name] - gradient).norm()) < 5e-4 * float(gradient.norm()), name


def test_what_lies_in_the_dark_is_not_asked_and_hardly_missed(trainer, monkeypatch):
    (ours, _), (twin, _) = seen(trainer, render_rays), seen(trainer, render_rays_dense)
    assert len(ours.transmittance) < 0.75 * len(twin.transmittance)
    assert float((ours.image - twin.image).detach().abs().max()) < MIN_TRANSMITTANCE
    assert float((ours.alpha - twin.alpha).detach().abs().max()) < MIN_TRANSMITTANCE
    # Everything that light reaches is there.
    for least in (0.01, 0.5):
        assert int((ours.transmittance > least).sum()) == int((twin.transmittance > least).sum())


def test_thinning_keeps_the_gradient_in_the_mean(trainer, monkeypatch):
    """Each of the few samples that are taken stands for those that are not: no part of the gradient is lost."""
    monkeypatch.setattr(module, "trace", whole())
    truth = gradients(trainer, *seen(trainer, render_rays))
    taken = {}
    for subsampling_threshold in (0.3, 3.0):
        monkeypatch.setattr(module, "trace", whole(subsampling_threshold))
        found, feature_gradients = seen(trainer, render_rays)
        subsampled = gradients(trainer, found, feature_gradients)
        taken[subsampling_threshold] = len(feature_gradients[0][0])
        for name, gradient in truth.items():
            error = float((subsampled[name] - gradient).norm()) / float(gradient.norm())
            assert error < {0.3: 0.05, 3.0: 0.5}[subsampling_threshold], name
        # Of many numbers the noise averages out: what is left would be a bias.
        for name in ("table", "hidden"):
            along = float((subsampled[name] * truth[name]).sum()) / float(truth[name].square().sum())
            assert along == pytest.approx(1.0, abs={0.3: 0.01, 3.0: 0.1}[subsampling_threshold]), name
    assert taken[3.0] < taken[0.3] < 0.6 * len(seen(trainer, render_rays)[0].transmittance)


def test_room_grows_with_the_samples(trainer, monkeypatch):
    monkeypatch.setattr(module, "trace", whole())
    plenty, _ = seen(trainer, render_rays)
    monkeypatch.setattr("pipeline.kernels.volume_rendering.INITIAL_SAMPLES_PER_RAY", 1)
    narrow, _ = seen(trainer, render_rays)
    assert len(plenty.transmittance) > 768 * 4
    assert torch.equal(plenty.image, narrow.image)


def test_rays_without_samples_see_nothing(trainer):
    origins = torch.tensor([[0.0, 1.0, 50.0], [0.0, 1.0, 50.0], [float("nan"), 0.0, 0.0]])
    directions = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]])
    rays = Rays(origins, directions, torch.zeros(3, dtype=torch.long), torch.full((3,), 0.5))
    grid, nothing = trainer.occupancy.grid(), torch.zeros(0, 3)
    pose_batch = trainer._pose_batch(torch.tensor([0]))
    found = render_rays(trainer.field, trainer.inverse, grid, rays, pose_batch, nothing, 0.01, 160, FeatureGradients())
    assert not found.image.any()
    assert not found.alpha.any()
    assert len(found.transmittance) == len(found.density_per_m) == 0
    assert all(np.isfinite(value.detach().numpy()).all() for value in found)
