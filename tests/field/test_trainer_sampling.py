"""Random samples of a training step, and the learning-rate schedules in closed form."""

from collections.abc import Sequence

import numpy as np
import pytest
import torch

from pipeline.field.optimiser import WARMUP_STEPS, learning_rate_factor, pose_learning_rate_factor
from pipeline.field.ray_batches import RayBatch
from pipeline.field.setup import create_trainer
from pipeline.field.trainer import Trainer
from tests.field.scene import field_config, painted_scene


@pytest.mark.parametrize("steps", [200, 600])
def test_the_learning_rate_rises_in_the_warm_up_and_decays_to_its_final_ratio(steps: int) -> None:
    config = field_config(steps=steps, final_learning_rate_ratio=0.05)
    assert learning_rate_factor(0, config) == pytest.approx(1 / WARMUP_STEPS)
    assert learning_rate_factor(WARMUP_STEPS - 1, config) == pytest.approx(0.05 ** ((WARMUP_STEPS - 1) / steps))
    assert learning_rate_factor(steps, config) == pytest.approx(0.05)
    whole = [learning_rate_factor(step, config) for step in range(steps)]
    assert np.argmax(whole) == WARMUP_STEPS - 1
    # After the warm-up the ratio of consecutive steps is constant.
    ratios = np.array(whole[WARMUP_STEPS:]) / whole[WARMUP_STEPS - 1 : -1]
    np.testing.assert_allclose(ratios, 0.05 ** (1 / steps), rtol=1e-12)


@pytest.mark.parametrize("start_fraction", [0.0, 0.25])
def test_the_pose_learning_rate_decays_to_a_tenth(start_fraction: float) -> None:
    config = field_config(steps=200, pose_start_fraction=start_fraction)
    assert pose_learning_rate_factor(round(200 * start_fraction), config) == pytest.approx(1.0)
    assert pose_learning_rate_factor(200, config) == pytest.approx(0.1)
    assert pose_learning_rate_factor(round(100 * (1 + start_fraction)), config) == pytest.approx(0.1**0.5)


def test_a_pose_refinement_that_starts_at_the_end_has_a_learning_rate() -> None:
    assert pose_learning_rate_factor(200, field_config(steps=200, pose_start_fraction=1.0)) == pytest.approx(1.0)


@pytest.fixture(scope="module")
def trainer() -> Trainer:
    scene, config = (
        painted_scene(4, 64),
        field_config(rays_per_step=600, frames_per_step=2, levels=2, log2_hashmap_size=10, min_clothing_offset_m=0.03),
    )
    masked_images = list(zip(scene.images, scene.masks, strict=True))
    return create_trainer(scene.body, scene.motion, scene.camera, masked_images, config)


def sample_batch(trainer: Trainer, step: int, frames: Sequence[int] = (0, 2)) -> RayBatch:
    return trainer.sampler.sample_rays(np.array(frames), step, trainer.inverse_skinning.cameras)


def test_every_ray_has_its_own_background(trainer: Trainer) -> None:
    background = sample_batch(trainer, 0).background
    assert len(background.unique(dim=0)) == len(background) > 300
    assert float(background.min()) >= 0
    assert float(background.max()) < 1
    # All colours are equally likely: with grey backgrounds alone, a grey field would not be penalised.
    assert background.mean(0).tolist() == pytest.approx([0.5] * 3, abs=0.06)
    assert (torch.corrcoef(background.T) - torch.eye(3)).abs().max() < 0.15


def test_the_step_determines_the_samples(trainer: Trainer) -> None:
    first, second, again = sample_batch(trainer, 0), sample_batch(trainer, 1), sample_batch(trainer, 0)
    for name in ("background", "jitter"):
        assert torch.equal(getattr(first, name), getattr(again, name))
        assert not torch.equal(getattr(first, name), getattr(second, name))


def test_the_rays_of_a_frame_do_not_depend_on_other_frames(trainer: Trainer) -> None:
    whole, parts = sample_batch(trainer, 3, (0, 2, 3)), [sample_batch(trainer, 3, frames) for frames in ((0,), (2, 3))]
    assert np.concatenate([part.pixel_index for part in parts]).tolist() == whole.pixel_index.tolist()
    for name in ("frame_index", "origins_m", "directions", "rgba", "background", "jitter"):
        assert torch.equal(torch.cat([getattr(part, name) for part in parts]), getattr(whole, name)), name
    assert len({row // 1000 for row in whole.pixel_index.tolist()}) > 3


def test_empty_points_are_in_empty_cells(trainer: Trainer) -> None:
    occupancy, (low, high) = trainer.occupancy, trainer.occupancy.bounds_m
    points = occupancy.sample_empty_points(2000, 100, np.random.default_rng(0))
    assert not occupancy.binary().contains(points).any()
    assert ((points >= low) & (points < high)).all()
    # There are no unobserved cells before the first update.
    assert len(points) == round(2000 * (1 - float(occupancy.occupied.float().mean())))
    assert torch.equal(points, occupancy.sample_empty_points(2000, 100, np.random.default_rng(0)))
    assert not torch.equal(points, occupancy.sample_empty_points(2000, 100, np.random.default_rng(1)))
    assert len(occupancy.sample_empty_points(0, 0, np.random.default_rng(0))) == 0


def test_frames_without_a_person_are_not_sampled() -> None:
    scene = painted_scene(4, 64)
    config = field_config(
        rays_per_step=600, frames_per_step=2, levels=2, log2_hashmap_size=10, min_clothing_offset_m=0.03
    )
    empty = np.zeros_like(scene.masks[0])
    masked_images = list(zip(scene.images, [*scene.masks[:1], empty, empty, empty], strict=True))
    trainer = create_trainer(scene.body, scene.motion, scene.camera, masked_images, config)
    assert trainer.sampler.frames_with_rays.tolist() == [0]
    losses = [trainer.step() for _ in range(3)]
    assert np.isfinite([loss["colour"] for loss in losses]).all()
    assert trainer.optimiser.nonfinite_steps == 0
    assert all(loss["samples"] > 0 for loss in losses)
