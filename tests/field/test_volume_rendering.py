"""Volume rendering: the compiled kernel, which ends rays early, against the dense reference; images and gradients."""

from functools import partial

import numpy as np
import pytest
import torch
from torch import Tensor

from pipeline.field import field as field_module
from pipeline.field import volume_rendering as module
from pipeline.field.inverse_skinning import Rays
from pipeline.field.trainer import MAX_SAMPLES_PER_RAY, Trainer
from pipeline.field.volume_rendering import PosedField, render_rays, render_rays_dense
from pipeline.kernels.hashgrid import FeatureGradients, add_table_gradient_
from pipeline.kernels.volume_rendering import MIN_TRANSMITTANCE, RenderOutput, RenderSettings
from tests.field.scene import make_trainer, sample_rays


@pytest.fixture(scope="module")
def trainer(scene) -> Trainer:
    """A half-trained field: some cells are opaque, and poses have moved since the last bake."""
    trainer = make_trainer(scene, steps=160, pose_start_fraction=0.1, occupancy_warmup_steps=8)
    for _ in range(120):
        trainer.step()
    return trainer


def rendered(
    trainer: Trainer, renderer, exact: bool = True, frames: tuple[int, ...] = (1, 4, 6)
) -> tuple[RenderOutput, FeatureGradients]:
    batch, feature_gradients = sample_rays(trainer, *frames), FeatureGradients()
    pose_batch = trainer.inverse_skinning.pose_batch(batch.frame_indices) if exact else None
    points = torch.tensor([[0.0, 0.9, 0.0], [0.3, 1.2, 0.1], [5.0, 5.0, 5.0]])
    found = renderer(
        posed_field(trainer), batch.rays, pose_batch, points, trainer.step_m, MAX_SAMPLES_PER_RAY, feature_gradients
    )
    return found, feature_gradients


def posed_field(trainer: Trainer) -> PosedField:
    return PosedField(trainer.field, trainer.inverse_skinning.inverse, trainer.occupancy.binary())


def gradients(trainer: Trainer, found: RenderOutput, feature_gradients: FeatureGradients) -> dict[str, Tensor]:
    """Gradients of a loss with a random weight for every ray, channel and point."""
    rng = torch.Generator().manual_seed(3)
    values = (found.image, found.alpha, 0.01 * found.density_per_m)
    loss = torch.stack([(value * torch.randn(value.shape, generator=rng)).sum() for value in values]).sum()
    parameters = trainer.optimiser.parameters
    by_parameter = torch.autograd.grad(loss, list(parameters.values()), allow_unused=True)
    table = torch.zeros_like(trainer.field.table)
    add_table_gradient_(table, feature_gradients, trainer.field.layout)
    named = zip(parameters, by_parameter, strict=True)
    return {"table": table} | {name: value for name, value in named if value is not None}


def exact_settings(subsampling_threshold: float = 0.0):
    """`RenderSettings` without early termination, by default without gradient subsampling."""
    return partial(RenderSettings, min_transmittance=0.0, gradient_subsampling_threshold=subsampling_threshold)


@pytest.mark.parametrize("exact", [True, False])
def test_the_kernel_without_shortcuts_equals_the_reference(trainer, monkeypatch, exact):
    monkeypatch.setattr(module, "RenderSettings", exact_settings())
    monkeypatch.setattr(field_module, "MIN_RELATIVE_GRADIENT", 0.0)
    (ours, feature_gradients), (twin, reference_feature_gradients) = (
        rendered(trainer, render_rays, exact),
        rendered(trainer, render_rays_dense, exact),
    )
    assert float(twin.alpha.detach().max()) > 0.9
    for name in ("image", "alpha"):
        torch.testing.assert_close(getattr(ours, name), getattr(twin, name), atol=2e-5, rtol=0)
    torch.testing.assert_close(ours.density_per_m, twin.density_per_m, atol=0, rtol=1e-4)
    assert len(ours.transmittance) == len(twin.transmittance) > 5000
    # Samples have no defined order: compare sorted values and sums.
    for name in ("transmittance", "weight"):
        mine, theirs = (getattr(found, name).double().sort().values for found in (ours, twin))
        torch.testing.assert_close(mine, theirs, atol=2e-5, rtol=0)
    weighted = [(found.canonical_m.double() * found.weight[:, None]).sum(0) for found in (ours, twin)]
    torch.testing.assert_close(*weighted, rtol=1e-5, atol=1e-4)
    mine, theirs = gradients(trainer, ours, feature_gradients), gradients(trainer, twin, reference_feature_gradients)
    assert mine.keys() == theirs.keys()
    assert ("shift_m" in mine) == exact
    for name, gradient in theirs.items():
        # A ReLU input near zero may have different signs.
        assert float((mine[name] - gradient).norm()) < 5e-4 * float(gradient.norm()), name


def test_early_termination_changes_images_by_less_than_its_threshold(trainer, monkeypatch):
    (ours, _), (twin, _) = rendered(trainer, render_rays), rendered(trainer, render_rays_dense)
    assert len(ours.transmittance) < 0.75 * len(twin.transmittance)
    assert float((ours.image - twin.image).detach().abs().max()) < MIN_TRANSMITTANCE
    assert float((ours.alpha - twin.alpha).detach().abs().max()) < MIN_TRANSMITTANCE
    # No sample with transmittance is missing.
    for least in (0.01, 0.5):
        assert int((ours.transmittance > least).sum()) == int((twin.transmittance > least).sum())


def test_gradient_subsampling_is_unbiased(trainer, monkeypatch):
    """The samples that are kept are weighted for those that are dropped."""
    monkeypatch.setattr(module, "RenderSettings", exact_settings())
    truth = gradients(trainer, *rendered(trainer, render_rays))
    taken = {}
    for subsampling_threshold in (0.3, 3.0):
        monkeypatch.setattr(module, "RenderSettings", exact_settings(subsampling_threshold))
        found, feature_gradients = rendered(trainer, render_rays)
        subsampled = gradients(trainer, found, feature_gradients)
        taken[subsampling_threshold] = len(feature_gradients[0][0])
        for name, gradient in truth.items():
            error = float((subsampled[name] - gradient).norm()) / float(gradient.norm())
            assert error < {0.3: 0.05, 3.0: 0.5}[subsampling_threshold], name
        # The noise averages out over many parameters; the projection on the true gradient shows a bias.
        for name in ("table", "hidden"):
            along = float((subsampled[name] * truth[name]).sum()) / float(truth[name].square().sum())
            assert along == pytest.approx(1.0, abs={0.3: 0.01, 3.0: 0.1}[subsampling_threshold]), name
    assert taken[3.0] < taken[0.3] < 0.6 * len(rendered(trainer, render_rays)[0].transmittance)


def test_the_sample_buffer_grows(trainer, monkeypatch):
    monkeypatch.setattr(module, "RenderSettings", exact_settings())
    large, _ = rendered(trainer, render_rays)
    monkeypatch.setattr("pipeline.kernels.volume_rendering.INITIAL_SAMPLES_PER_RAY", 1)
    small, _ = rendered(trainer, render_rays)
    assert len(large.transmittance) > 768 * 4
    assert torch.equal(large.image, small.image)


def test_rays_without_samples_are_transparent(trainer):
    origins = torch.tensor([[0.0, 1.0, 50.0], [0.0, 1.0, 50.0], [float("nan"), 0.0, 0.0]])
    directions = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]])
    rays = Rays(origins, directions, torch.zeros(3, dtype=torch.long), torch.full((3,), 0.5))
    pose_batch, no_points = trainer.inverse_skinning.pose_batch(torch.tensor([0])), torch.zeros(0, 3)
    found = render_rays(posed_field(trainer), rays, pose_batch, no_points, 0.01, 160, FeatureGradients())
    assert not found.image.any()
    assert not found.alpha.any()
    assert len(found.transmittance) == len(found.density_per_m) == 0
    assert all(np.isfinite(value.detach().numpy()).all() for value in found)
