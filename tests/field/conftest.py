"""Fixtures that several test files of the field share; none of them may be changed by a test."""

import pytest

from pipeline.body.body import Body, load_anny
from pipeline.field.trainer import Trainer
from tests.field.scene import PaintedScene, make_trainer, painted_scene


@pytest.fixture(scope="session")
def body() -> Body:
    anny = load_anny()
    return anny.at_shape(anny.shape_defaults)


@pytest.fixture(scope="session")
def scene() -> PaintedScene:
    """Twelve frames of 110 px."""
    return painted_scene(12, 110)


@pytest.fixture(scope="session")
def trained(scene: PaintedScene) -> Trainer:
    """A field after 60 steps in the fitted poses."""
    trainer = make_trainer(scene, steps=60, pose_refinement=False)
    for _ in range(60):
        trainer.step()
    return trainer
