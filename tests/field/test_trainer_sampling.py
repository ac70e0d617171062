"""What a step of learning draws, and the learning rates at both ends, in closed form."""

from collections.abc import Sequence
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from pipeline.field.config import FieldConfig
from pipeline.field.setup import create_trainer
from pipeline.field.trainer import WARMUP_STEPS, RayBatch, Trainer
from tests.field.scene import painted_scene


def at(completed_steps: int, **options) -> SimpleNamespace:
    """All that a rate depends on."""
    return SimpleNamespace(completed_steps=completed_steps, config=FieldConfig(**options))


@pytest.mark.parametrize("steps", [200, 600])
def test_the_rate_rises_in_the_warm_up_and_ends_at_its_last_part(steps: int) -> None:
    options = {"steps": steps, "final_learning_rate_ratio": 0.05}
    assert Trainer._learning_rate_factor(at(0, **options)) == pytest.approx(1 / WARMUP_STEPS)
    assert Trainer._learning_rate_factor(at(WARMUP_STEPS - 1, **options)) == pytest.approx(
        0.05 ** ((WARMUP_STEPS - 1) / steps)
    )
    assert Trainer._learning_rate_factor(at(steps, **options)) == pytest.approx(0.05)
    whole = [Trainer._learning_rate_factor(at(completed_steps, **options)) for completed_steps in range(steps)]
    assert np.argmax(whole) == WARMUP_STEPS - 1
    # After the warm-up each step takes the same part of the one before.
    ratios = np.array(whole[WARMUP_STEPS:]) / whole[WARMUP_STEPS - 1 : -1]
    np.testing.assert_allclose(ratios, 0.05 ** (1 / steps), rtol=1e-12)


@pytest.mark.parametrize("begun", [0.0, 0.25])
def test_the_poses_rate_is_whole_at_first_and_a_tenth_at_the_end(begun: float) -> None:
    options = {"steps": 200, "pose_start_fraction": begun}
    assert Trainer._pose_learning_rate_factor(at(round(200 * begun), **options)) == pytest.approx(1.0)
    assert Trainer._pose_learning_rate_factor(at(200, **options)) == pytest.approx(0.1)
    assert Trainer._pose_learning_rate_factor(at(round(100 * (1 + begun)), **options)) == pytest.approx(0.1**0.5)


def test_poses_that_begin_at_the_very_end_have_a_rate() -> None:
    assert Trainer._pose_learning_rate_factor(at(200, steps=200, pose_start_fraction=1.0)) == pytest.approx(1.0)


@pytest.fixture(scope="module")
def trainer() -> Trainer:
    scene, config = (
        painted_scene(4, 64),
        FieldConfig(rays=600, frames_per_step=2, levels=2, log2_rows=10, min_clothing_offset_m=0.03),
    )
    masked_images = list(zip(scene.images, scene.masks, strict=True))
    return create_trainer(scene.body, scene.motion, scene.camera, masked_images, config)


def drawn(trainer: Trainer, step: int, frames: Sequence[int] = (0, 2)) -> RayBatch:
    trainer.completed_steps = step
    return trainer._sample_batch(np.array(frames))


def test_every_ray_has_a_background_of_its_own(trainer: Trainer) -> None:
    background = drawn(trainer, 0).background
    assert len(background.unique(dim=0)) == len(background) > 300
    assert float(background.min()) >= 0
    assert float(background.max()) < 1
    # Every colour is as likely: before greys alone a grey field would pass for nothing.
    assert background.mean(0).tolist() == pytest.approx([0.5] * 3, abs=0.06)
    assert (torch.corrcoef(background.T) - torch.eye(3)).abs().max() < 0.15


def test_a_step_draws_anew_and_always_the_same(trainer: Trainer) -> None:
    first, second, again = drawn(trainer, 0), drawn(trainer, 1), drawn(trainer, 0)
    for name in ("background", "jitter"):
        assert torch.equal(getattr(first, name), getattr(again, name))
        assert not torch.equal(getattr(first, name), getattr(second, name))


def test_a_frame_s_rays_are_the_same_whatever_is_drawn_with_it(trainer: Trainer) -> None:
    whole, parts = drawn(trainer, 3, (0, 2, 3)), [drawn(trainer, 3, frames) for frames in ((0,), (2, 3))]
    assert np.concatenate([part.rows for part in parts]).tolist() == whole.rows.tolist()
    for name in ("frame", "origins_m", "directions", "rgba", "background", "jitter"):
        assert torch.equal(torch.cat([getattr(part, name) for part in parts]), getattr(whole, name)), name
    assert len({row // 1000 for row in whole.rows.tolist()}) > 3


def test_points_that_should_be_empty_are(trainer: Trainer) -> None:
    occupancy, (low, high) = trainer.occupancy, trainer.occupancy.bounds_m
    points = occupancy.sample_empty_points(2000, 100, np.random.default_rng(0))
    assert not occupancy.grid().contains(points).any()
    assert ((points >= low) & (points < high)).all()
    # No cell is hidden before rays had time to see it; of the box, its empty part alone.
    assert len(points) == round(2000 * (1 - float(occupancy.occupied.float().mean())))
    assert torch.equal(points, occupancy.sample_empty_points(2000, 100, np.random.default_rng(0)))
    assert not torch.equal(points, occupancy.sample_empty_points(2000, 100, np.random.default_rng(1)))
    assert len(occupancy.sample_empty_points(0, 0, np.random.default_rng(0))) == 0


def test_frames_without_a_person_are_passed_over() -> None:
    scene = painted_scene(4, 64)
    config = FieldConfig(rays=600, frames_per_step=2, levels=2, log2_rows=10, min_clothing_offset_m=0.03)
    nothing = np.zeros_like(scene.masks[0])
    masked_images = list(zip(scene.images, [*scene.masks[:1], nothing, nothing, nothing], strict=True))
    trainer = create_trainer(scene.body, scene.motion, scene.camera, masked_images, config)
    assert trainer.frames_with_rays.tolist() == [0]
    losses = [trainer.step() for _ in range(3)]
    assert np.isfinite([loss["colour"] for loss in losses]).all()
    assert trainer.nonfinite_steps == 0
    assert all(loss["samples"] > 0 for loss in losses)
