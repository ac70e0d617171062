"""Stage one on a device that is not the CPU: a graphics card where there is one, else one that keeps its rules."""

from contextlib import nullcontext

import numpy as np
import pytest
import torch

from pipeline.body.body import canonical_to_world
from pipeline.field.config import FieldConfig
from pipeline.field.rendering import render_field
from pipeline.field.setup import create_trainer
from pipeline.field.validation import Validator
from tests.elsewhere import FAKE_DEVICE, elsewhere
from tests.field.scene import painted_scene
from tests.field.test_trainer import TINY, TRAIN

FEW = {
    "rays": 256,
    "occupancy_warmup_steps": 4,
    "occupancy_update_interval": 4,
    "pose_start_fraction": 0.25,
    "steps": 24,
}
MOST_OPERATIONS = 1000
"""Of a step with poses. Each takes a launch on a graphics card, some five microseconds, whatever its size."""


@pytest.fixture(scope="module")
def scene():
    return painted_scene(12, 110)


def make_trainer(scene, device, **options):
    config = FieldConfig(**(TINY | FEW | options))
    masked_images = [(scene.images[row], scene.masks[row]) for row in TRAIN]
    return create_trainer(scene.body, scene.motion.select(TRAIN), scene.camera, masked_images, config, device)


def learn(scene, device, steps, **options):
    trainer = make_trainer(scene, device, **options)
    return trainer, [trainer.step() for _ in range(steps)]


def compare(scene, device, **options):
    """The first steps agree to rounding, later ones in how well they explain the pictures."""
    steps = FEW["steps"]
    _, here = learn(scene, torch.device("cpu"), steps, **options)
    there_learning, there = learn(scene, device, steps, **options)
    # Here rays end with their light, elsewhere all samples are asked for; what lies behind is seen by neither.
    asked_here, asked_there = here[0].pop("samples"), there[0].pop("samples")
    assert 0.99 * asked_there < asked_here <= asked_there
    for name, value in here[0].items():
        assert there[0][name] == pytest.approx(value, rel=2e-3, abs=1e-6), name
    assert there[-1]["colour"] == pytest.approx(here[-1]["colour"], rel=0.1)
    assert there[-1]["colour"] < 0.8 * there[0]["colour"]
    assert float(there_learning.poses.shift_m.detach().abs().max()) > 0
    return there_learning


@pytest.mark.parametrize("options", [{}, {"occupancy": "attention"}, {"inverse_skinning": "nearest"}])
def test_learns_elsewhere_what_it_learns_here(scene, options):
    with elsewhere():
        compare(scene, FAKE_DEVICE, **options)


@pytest.mark.cuda
def test_learns_on_a_graphics_card_what_it_learns_here(scene, cuda):
    compare(scene, torch.device(cuda))


@pytest.fixture(scope="module", params=["elsewhere", "cuda"])
def learnt(request, scene):
    """A field that learnt on another device, inside of that device's context."""
    device = FAKE_DEVICE if request.param == "elsewhere" else torch.device(request.getfixturevalue("cuda"))
    with elsewhere() if device == FAKE_DEVICE else nullcontext() as calls:
        yield learn(scene, device, 12)[0], calls


def test_pictures_and_checkpoints_come_back_to_the_cpu(scene, learnt):
    trainer, _ = learnt
    pose = canonical_to_world(scene.body, scene.motion.select(np.array([2])))[0]
    shown = render_field(trainer.field, trainer.occupancy.grid(), scene.body, pose, scene.camera)
    state = {name: value.cpu() for name, value in trainer.state().items()}
    again = make_trainer(scene, torch.device("cpu"))
    again.load_state(state)
    here = render_field(again.field, again.occupancy.grid(), scene.body, pose, scene.camera)
    assert float(here[..., 3].amax()) > 0.5
    assert float((shown - here).abs().mean()) < 1e-4
    back = make_trainer(scene, trainer.device)
    back.load_state(state)
    assert back.completed_steps == trainer.completed_steps


def test_validation_frames_are_scored_with_refined_poses(scene, learnt):
    trainer, _ = learnt
    validator = Validator(
        scene.motion.select(np.array([2, 5])), scene.camera, [(scene.images[r], scene.masks[r]) for r in (2, 5)]
    )
    subsampled_validator = validator.subsampled()
    renders = subsampled_validator.render(trainer, subsampled_validator.pose(trainer, refined=True))
    assert all(np.isfinite(score) for score in subsampled_validator.psnr_per_frame_db(renders))


def test_a_step_is_few_operations(scene):
    with elsewhere() as calls:
        trainer = make_trainer(scene, FAKE_DEVICE)
        for _ in range(FEW["steps"] - 2):
            trainer.step()
        before = calls.count
        trainer.step()
        assert trainer.refines_poses
        assert 100 < calls.count - before < MOST_OPERATIONS


def test_elsewhere_keeps_the_rules_of_a_graphics_card():
    with elsewhere():
        there = torch.arange(6.0).to(FAKE_DEVICE)
        with pytest.raises(RuntimeError, match="lies on the CPU"):
            there + torch.ones(6)
        with pytest.raises(RuntimeError, match="numpy"):
            there.numpy()
        leaf = torch.ones(3, device=FAKE_DEVICE, requires_grad=True)
        (leaf.square().sum() * 2.0).backward()
        assert leaf.grad.tolist() == [4.0, 4.0, 4.0]
        assert (there[2:4] + 1).cpu().tolist() == [3.0, 4.0]
