"""The presets of published methods: their constants, and that each of them learns."""

import numpy as np
import pytest
import torch

from pipeline.body.body import canonical_to_world
from pipeline.core.config import build_config, load_layers
from pipeline.field.baselines.positional_mlp import PositionalMlp
from pipeline.field.config import FieldConfig
from pipeline.field.field import EMPTY_GRID_LAYOUT, RadianceField, hash_grid_layout
from pipeline.field.files import load_field, save_field
from pipeline.field.rendering import render_field
from pipeline.field.setup import create_trainer
from tests.field.scene import SETTING_NAMES, painted_scene, psnr_on_white_db

BASELINES = ("instantavatar", "animnerf", "ihm", "visual-hull")
TRAIN = np.array([0, 1, 3, 4, 6, 7, 9, 10])
HELD_OUT = 2
STEPS = 30
SMALL = {
    "steps": STEPS,
    "rays_per_step": 192,
    "frames_per_step": 1,
    "log2_hashmap_size": 15,
    "levels": 8,
    "min_clothing_offset_m": 0.04,
    "step_fraction": 0.02,
    "finest_cell_px": 0.5,
    "occupancy_warmup_steps": 16,
    "pose_start_fraction": 0.85,
    "table_learning_rate": 0.1,
    "network_learning_rate": 0.02,
    "final_learning_rate_ratio": 0.5,
}
DEEP = {"network_learning_rate": 2e-3, "hidden_width": 128}


@pytest.fixture(scope="module")
def scene():
    return painted_scene(12, 96)


def preset_config(preset, **changes):
    overrides = {
        f"field.settings.{key}" if key in SETTING_NAMES else f"field.{key}": value for key, value in changes.items()
    }
    return build_config("field", FieldConfig, load_layers(preset, overrides))


def make_trainer(scene, config):
    masked_images = [(scene.images[row], scene.masks[row]) for row in TRAIN]
    return create_trainer(scene.body, scene.motion.select(TRAIN), scene.camera, masked_images, config)


def psnr_db(scene, trainer, field=None):
    """PSNR of a frame that was not used for training."""
    pose = canonical_to_world(scene.body, scene.motion.select(np.array([HELD_OUT])))[0]
    field, grid = field or trainer.field, trainer.occupancy.binary()
    render = render_field(field, grid, scene.body, pose, scene.camera, trainer.scene.skin)
    return psnr_on_white_db(render, scene.images[HELD_OUT], scene.masks[HELD_OUT])


@pytest.mark.parametrize(
    ("preset", "constants"),
    [
        ("instantavatar", {"levels": 16, "features_per_level": 2, "log2_hashmap_size": 19}),
        ("instantavatar", {"inverse_skinning": "broyden", "occupancy": "plain", "huber_delta": 1.0}),
        ("animnerf", {"network": "positional_mlp", "hidden_width": 256, "inverse_skinning": "nearest"}),
        ("ihm", {"occupancy": "attention", "occupancy_decay": 0.95, "attention_learning_rate": 1e-4, "steps": 5000}),
        ("visual-hull", {"network": "visual_hull", "steps": 0, "pose_refinement": False}),
    ],
)
def test_presets_have_the_constants_of_the_papers(preset, constants):
    config = preset_config(preset)
    found = {key: getattr(config.settings if key in SETTING_NAMES else config, key) for key in constants}
    assert found == constants


@pytest.mark.slow
@pytest.mark.parametrize(
    ("preset", "render_method", "gain_db"),
    [("instantavatar", "baked", 1.5), ("animnerf", "nearest", 0.5), ("ihm", "baked", 1.5)],
)
def test_a_baseline_learns_refines_poses_and_is_saved(preset, render_method, gain_db, scene, tmp_path):
    trainer = make_trainer(scene, preset_config(preset, **SMALL | (DEEP if preset == "animnerf" else {})))
    before = psnr_db(scene, trainer)
    losses = [trainer.step() for _ in range(STEPS)]
    assert np.mean([loss["colour"] for loss in losses[-5:]]) < 0.5 * losses[0]["colour"]
    assert psnr_db(scene, trainer) > before + gain_db
    assert 0 < float(trainer.poses.rotation_rad.detach().abs().max()) < 0.1
    assert saved_psnr_db(scene, trainer, tmp_path, render_method) == psnr_db(scene, trainer)


def test_a_visual_hull_renders_a_new_pose_and_is_saved(scene, tmp_path):
    trainer = make_trainer(scene, preset_config("visual-hull", min_clothing_offset_m=0.04))
    assert trainer.config.steps == 0
    assert psnr_db(scene, trainer) > 20
    assert saved_psnr_db(scene, trainer, tmp_path, "baked") == psnr_db(scene, trainer)


@pytest.mark.parametrize("trunk", [None, PositionalMlp(2, 16)])
def test_colour_depends_on_every_parameter_of_a_field(trunk):
    """The mesh stage optimises all of them."""
    bounds_m = np.array([[0, 0, 0], [1, 1, 1]], dtype=np.float32)
    layout = EMPTY_GRID_LAYOUT if trunk else hash_grid_layout(bounds_m, 0.1, 2, 2, 10)
    field = RadianceField(bounds_m, layout, 16, trunk=trunk)
    colour, _ = field(torch.rand(50, 3, generator=torch.Generator().manual_seed(0)))
    gradients = torch.autograd.grad(colour.sum(), list(field.parameters()))
    assert all(bool(gradient.abs().sum() > 0) for gradient in gradients)


def saved_psnr_db(scene, trainer, folder, render_method):
    """PSNR after the field was written and read."""
    save_field(folder / "field.safetensors", trainer.field)
    again = load_field(folder / "field.safetensors")
    assert again.inverse_skinning == render_method
    return psnr_db(scene, trainer, again)
