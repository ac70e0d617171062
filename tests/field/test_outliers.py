"""Foreign objects: a ball inside the mask of every other frame, at a different place each time."""

import numpy as np
import pytest
import torch

from pipeline.field.setup import create_trainer
from pipeline.field.trainer import Trainer
from tests.field.scene import PaintedScene, field_config, painted_scene, sample_rays

SIDE_PX, RADIUS_PX, STEPS = 256, 14, 200
GREEN = np.array([40, 250, 60], np.uint8)


@pytest.fixture(scope="module")
def scene() -> PaintedScene:
    return painted_scene(12, SIDE_PX)


def ball_of(scene: PaintedScene, frame: int) -> np.ndarray:
    """Pixels of the ball in a frame; it moves up and down along the middle of the body."""
    rows, columns = np.nonzero(scene.masks[frame] > 127)
    y = np.quantile(rows, 0.3 + 0.4 * (0.5 + 0.5 * np.sin(2.0 * frame)))
    x = np.median(columns[np.abs(rows - y) < 3])
    height, width = np.mgrid[:SIDE_PX, :SIDE_PX]
    return np.hypot(width - x, height - y) < RADIUS_PX


def train(scene: PaintedScene, **options) -> Trainer:
    masked_images = []
    for frame, (image, mask) in enumerate(zip(scene.images, scene.masks, strict=True)):
        ball = ball_of(scene, frame) & (frame % 2 == 0)
        masked_images.append((np.where(ball[..., None], GREEN, image), np.where(ball, 255, mask).astype(np.uint8)))
    config = field_config(
        rays_per_step=1024,
        frames_per_step=4,
        steps=STEPS,
        levels=4,
        log2_hashmap_size=14,
        pose_refinement=False,
        **options,
    )
    trainer = create_trainer(scene.body, scene.motion, scene.camera, masked_images, config)
    for _ in range(STEPS):
        trainer.step()
    return trainer


def green_excess(scene: PaintedScene, trainer: Trainer) -> float:
    """Mean excess of green over the person in the renders, at the pixels of the ball."""
    xy, greener = trainer.scene.pool.xy_px, []
    for frame in range(0, len(scene.images), 2):
        result = trainer.forward_backward(np.array([frame]), torch.zeros(0, 3), 1.0)
        pixels = xy[result.batch.pixel_index]
        on_ball = ball_of(scene, frame)[pixels[:, 1], pixels[:, 0]]
        truth = scene.images[frame][pixels[:, 1], pixels[:, 0]][on_ball] / 255
        greener.append(result.rendered.image.detach().numpy()[on_ball, 1] - truth[:, 1])
    return float(np.concatenate(greener).mean())


@pytest.mark.slow
def test_a_foreign_object_is_not_learnt(scene):
    robust, plain = train(scene), train(scene, outlier_threshold=1e6)
    xy, on_ball, off_ball = robust.scene.pool.xy_px, [], []
    for frame in range(0, len(scene.images), 2):
        batch = sample_rays(robust, frame)
        ball, inlier_weight = (
            ball_of(scene, frame)[xy[batch.pixel_index, 1], xy[batch.pixel_index, 0]],
            batch.inlier_weight.numpy(),
        )
        on_ball.append(inlier_weight[ball])
        off_ball.append(inlier_weight[~ball])
        # Pixels outside the mask always have the weight 1.
        assert (inlier_weight[batch.rgba[:, 3].numpy() == 0] == 1).all()
    # Some pixels off the ball share a tile with its border.
    assert np.concatenate(on_ball).mean() < 0.5
    assert np.concatenate(off_ball).mean() > 0.9
    assert green_excess(scene, robust) < 0.5 * green_excess(scene, plain)
