"""The presets that others' methods are compared by: each is the same code with other options, and learns."""

import numpy as np
import pytest
import torch

from pipeline.body.body import canonical_to_world
from pipeline.core.config import build, load_layers
from pipeline.field.config import FieldConfig
from pipeline.field.field import NO_GRID, Field, choose_layout
from pipeline.field.files import load_field, save_field
from pipeline.field.positional_mlp import FrequencyTrunk
from pipeline.field.rendering import over_white, render_field
from pipeline.field.setup import start_learning
from tests.field.scene import painted_scene

BASELINES = ("instantavatar", "animnerf", "ihm", "visual-hull")
TRAIN = np.array([0, 1, 3, 4, 6, 7, 9, 10])
HELD_OUT = 2
STEPS = 30
LITTLE = {
    "steps": STEPS,
    "rays": 192,
    "frames_per_step": 1,
    "log2_rows": 15,
    "levels": 8,
    "margin_m": 0.04,
    "step_fraction": 0.02,
    "finest_cell_px": 0.5,
    "occupancy_start": 16,
    "pose_start": 0.85,
    "table_rate": 0.1,
    "network_rate": 0.02,
    "final_rate": 0.5,
}
DEEP = {"network_rate": 2e-3, "hidden_width": 128}


@pytest.fixture(scope="module")
def scene():
    return painted_scene(12, 96)


def options(preset, **changes):
    return build("field", FieldConfig, load_layers(preset, {f"field.{key}": value for key, value in changes.items()}))


def begin(scene, config):
    pictures = [(scene.images[row], scene.masks[row]) for row in TRAIN]
    return start_learning(scene.body, scene.motion.select(TRAIN), scene.camera, pictures, config)


def psnr_db(scene, learning, field=None):
    """Of a frame that was not learnt from, on white."""
    pose = canonical_to_world(scene.body, scene.motion.select(np.array([HELD_OUT])))[0]
    field, grid = field or learning.field, learning.occupancy.grid()
    shown = over_white(render_field(field, grid, scene.body, pose, scene.camera, learning.scene.skin))
    mask = torch.from_numpy(scene.masks[HELD_OUT])[..., None] / 255
    truth = torch.from_numpy(scene.images[HELD_OUT]) / 255 * mask + 1 - mask
    return -10 * float((shown - truth).square().mean().log10())


@pytest.mark.parametrize(
    ("preset", "facts"),
    [
        ("instantavatar", {"levels": 16, "features": 2, "log2_rows": 19, "inverse_skinning": "broyden"}),
        ("instantavatar", {"occupancy": "plain", "huber_delta": 1.0, "table_rate": 0.01}),
        ("animnerf", {"network": "frequency", "hidden_width": 256, "inverse_skinning": "nearest"}),
        ("ihm", {"occupancy": "attention", "occupancy_decay": 0.95, "attention_rate": 1e-4, "steps": 5000}),
        ("visual-hull", {"network": "hull", "steps": 0, "pose_refinement": False}),
    ],
)
def test_presets_are_what_the_papers_say(preset, facts):
    config = options(preset)
    assert {key: getattr(config, key) for key in facts} == facts


@pytest.mark.parametrize(
    ("preset", "shown_by", "gain_db"),
    [("instantavatar", "baked", 1.5), ("animnerf", "nearest", 0.5), ("ihm", "baked", 1.5)],
)
def test_a_baseline_learns_moves_poses_and_returns_from_disk(preset, shown_by, gain_db, scene, tmp_path):
    learning = begin(scene, options(preset, **LITTLE | (DEEP if preset == "animnerf" else {})))
    before = psnr_db(scene, learning)
    losses = [learning.step() for _ in range(STEPS)]
    assert np.mean([loss["colour"] for loss in losses[-5:]]) < 0.5 * losses[0]["colour"]
    assert psnr_db(scene, learning) > before + gain_db
    assert 0 < float(learning.poses.rotation_rad.detach().abs().max()) < 0.1
    assert shown_again_db(scene, learning, tmp_path, shown_by) == psnr_db(scene, learning)


def test_a_hull_shows_a_new_pose_without_a_step_and_returns_from_disk(scene, tmp_path):
    learning = begin(scene, options("visual-hull", margin_m=0.04))
    assert learning.config.steps == 0
    assert psnr_db(scene, learning) > 20
    assert shown_again_db(scene, learning, tmp_path, "baked") == psnr_db(scene, learning)


@pytest.mark.parametrize("trunk", [None, FrequencyTrunk(2, 16)])
def test_colour_reaches_every_parameter_of_a_field(trunk):
    """The mesh stage asks for the gradients of all of them."""
    bounds_m = np.array([[0, 0, 0], [1, 1, 1]], dtype=np.float32)
    layout = NO_GRID if trunk else choose_layout(bounds_m, 0.1, 2, 2, 10)
    field = Field(bounds_m, layout, 16, trunk=trunk)
    colour, _ = field(torch.rand(50, 3, generator=torch.Generator().manual_seed(0)))
    gradients = torch.autograd.grad(colour.sum(), list(field.parameters()))
    assert all(bool(gradient.abs().sum() > 0) for gradient in gradients)


def shown_again_db(scene, learning, folder, shown_by):
    """The score after the field was written and read."""
    save_field(folder / "field.safetensors", learning.field)
    again = load_field(folder / "field.safetensors")
    assert again.inverse_skinning == shown_by
    return psnr_db(scene, learning, again)
