"""What passes before the person: a ball that the masks hold, in every other frame, elsewhere each time."""

import numpy as np
import pytest
import torch

from pipeline.field.config import FieldConfig
from pipeline.field.setup import create_trainer
from pipeline.field.trainer import Trainer
from tests.field.scene import PaintedScene, painted_scene

SIDE_PX, RADIUS_PX, STEPS = 256, 14, 200
GREEN = np.array([40, 250, 60], np.uint8)


@pytest.fixture(scope="module")
def scene() -> PaintedScene:
    return painted_scene(12, SIDE_PX)


def ball_of(scene: PaintedScene, frame: int) -> np.ndarray:
    """Where the ball is in a frame: somewhere along the middle of the body, up and down."""
    rows, columns = np.nonzero(scene.masks[frame] > 127)
    y = np.quantile(rows, 0.3 + 0.4 * (0.5 + 0.5 * np.sin(2.0 * frame)))
    x = np.median(columns[np.abs(rows - y) < 3])
    height, width = np.mgrid[:SIDE_PX, :SIDE_PX]
    return np.hypot(width - x, height - y) < RADIUS_PX


def learnt(scene: PaintedScene, **options) -> Trainer:
    masked_images = []
    for frame, (image, mask) in enumerate(zip(scene.images, scene.masks, strict=True)):
        ball = ball_of(scene, frame) & (frame % 2 == 0)
        masked_images.append((np.where(ball[..., None], GREEN, image), np.where(ball, 255, mask).astype(np.uint8)))
    config = FieldConfig(
        rays=1024, frames_per_step=4, steps=STEPS, levels=4, log2_rows=14, pose_refinement=False, **options
    )
    trainer = create_trainer(scene.body, scene.motion, scene.camera, masked_images, config)
    for _ in range(STEPS):
        trainer.step()
    return trainer


def green_there(scene: PaintedScene, trainer: Trainer) -> float:
    """How much greener than the person rays see it where a ball was in the way."""
    xy, greener = trainer.scene.pool.xy_px, []
    for frame in range(0, len(scene.images), 2):
        result = trainer._forward_backward(np.array([frame]), torch.zeros(0, 3), 1.0)
        places = xy[result.batch.rows]
        here = ball_of(scene, frame)[places[:, 1], places[:, 0]]
        truth = scene.images[frame][places[:, 1], places[:, 0]][here] / 255
        greener.append(result.rendered.image.detach().numpy()[here, 1] - truth[:, 1])
    return float(np.concatenate(greener).mean())


def test_what_passes_before_the_person_is_not_learnt(scene):
    careful, trusting = learnt(scene), learnt(scene, outlier_threshold=1e6)
    xy, on_ball, beside = careful.scene.pool.xy_px, [], []
    for frame in range(0, len(scene.images), 2):
        batch = careful._sample_batch(np.array([frame]))
        ball, inlier_weight = ball_of(scene, frame)[xy[batch.rows, 1], xy[batch.rows, 0]], batch.inlier_weight.numpy()
        on_ball.append(inlier_weight[ball])
        beside.append(inlier_weight[~ball])
        # What lies outside the mask is believed always, so that nothing is left standing there.
        assert (inlier_weight[batch.rgba[:, 3].numpy() == 0] == 1).all()
    # Tiles are wider than the ball's rim: some of what is beside it shares them.
    assert np.concatenate(on_ball).mean() < 0.5
    assert np.concatenate(beside).mean() > 0.9
    assert green_there(scene, careful) < 0.5 * green_there(scene, trusting)
