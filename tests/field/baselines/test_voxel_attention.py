"""Voxel attention: gradients through the rendered density, the frequency of occupancy, and its state."""

import numpy as np
import pytest
import torch

from pipeline.field.baselines.voxel_attention import AttentionOccupancyGrid, VoxelAttention
from pipeline.field.files import load_field, save_field
from tests.field.occupancy_ball import STEP_M, ball_density, ball_grid, record_rays
from tests.field.scene import make_trainer


def test_weights_are_high_before_training():
    weight = VoxelAttention(0.1, 0)(torch.rand(50) * 100, torch.rand(50) * 0.1, torch.rand(50)).detach()
    assert 0.6 < float(weight.min()) <= float(weight.max()) < 1


def test_frequency_starts_as_that_of_the_masks_and_follows_the_opacity():
    grid, rng = ball_grid(True), np.random.default_rng(0)
    start = grid.frequency.clone()
    torch.testing.assert_close(start, grid.mask_fraction)
    for _ in range(60):
        record_rays(grid, rng)
        grid.update(ball_density, STEP_M, rng)
    inside, outside = grid.distance_m < -0.05, grid.distance_m > 0.05
    assert float(grid.frequency[inside].min()) > 0.99
    assert float(grid.frequency[outside].max()) < 0.01
    assert float(start[outside].mean()) > 0.05
    assert grid.frequency.min() >= 0
    assert grid.frequency.max() <= 1


def test_density_of_the_network_input_is_free_of_the_weights():
    grid, rng = ball_grid(True), np.random.default_rng(0)
    weights = grid.gate().detach().reshape(-1)[grid.candidate_cells]
    assert float(weights.max()) < 0.97
    gate = iter([weights])
    grid.update(lambda points: 200.0 * next(gate), STEP_M, rng)
    torch.testing.assert_close(grid.density_per_m, torch.full_like(weights, 200.0))


@pytest.fixture(scope="module")
def attention_trainer(scene):
    trainer = make_trainer(scene, steps=60, occupancy="attention", occupancy_warmup_steps=8, pose_refinement=False)
    for _ in range(20):
        trainer.step()
    return trainer


def image_loss(trainer) -> tuple[float, dict[str, torch.Tensor]]:
    """Losses of one batch, and the gradients that the optimiser would get for the attention."""
    frames = np.array([0, 3, 5])
    result = trainer.forward_backward(frames, trainer.field.bounds_m[:0], 1.0)
    gradients = trainer._through_gate(dict(result.gradients))
    return float(torch.stack(list(result.losses.values())).double().sum()), gradients


def test_losses_of_images_reach_the_attention_as_finite_differences_say(attention_trainer):
    """Rays end early and small gradients are subsampled, so the agreement is not exact."""
    trainer = attention_trainer
    _, gradients = image_loss(trainer)
    named = trainer.occupancy.parameters()
    assert set(named) <= set(gradients)
    for name, parameter in named.items():
        direction = gradients[name] / gradients[name].norm()
        values = []
        for sign in (1.0, -1.0):
            kept = parameter.detach().clone()
            with torch.no_grad():
                parameter += sign * 0.02 * direction
            trainer.field.gate = trainer.occupancy.gate()
            values.append(image_loss(trainer)[0])
            with torch.no_grad():
                parameter.copy_(kept)
        trainer.field.gate = trainer.occupancy.gate()
        difference = (values[0] - values[1]) / 0.04
        assert difference == pytest.approx(float(gradients[name].norm()), rel=0.1), name


def test_training_moves_the_attention_and_the_field_keeps_its_gate(scene, tmp_path):
    trainer = make_trainer(scene, steps=60, occupancy="attention", occupancy_warmup_steps=8)
    before = trainer.occupancy.gate().detach().clone()
    for _ in range(24):
        trainer.step()
    after = trainer.field.gate.detach()
    assert float((after - before).abs().max()) > 0.05
    assert isinstance(trainer.occupancy, AttentionOccupancyGrid)
    save_field(tmp_path / "field.safetensors", trainer.field)
    loaded = load_field(tmp_path / "field.safetensors")
    points_m = torch.rand(200, 3) * (loaded.bounds_m[1] - loaded.bounds_m[0]) + loaded.bounds_m[0]
    torch.testing.assert_close(loaded.density(points_m), trainer.field.density(points_m))
    loaded.gate = None
    assert not torch.allclose(loaded.density(points_m), trainer.field.density(points_m))


def test_a_field_without_attention_has_no_gate(scene):
    trainer = make_trainer(scene, steps=10)
    trainer.step()
    assert trainer.field.gate is None
    assert "gate" not in trainer.field.state_dict()
