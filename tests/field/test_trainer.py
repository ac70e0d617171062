from functools import partial

import numba
import numpy as np
import pytest
import torch

from pipeline.body.body import canonical_to_world
from pipeline.field import volume_rendering as look
from pipeline.field.config import FieldConfig
from pipeline.field.inverse_skinning import Rays
from pipeline.field.rendering import over_white, render_field
from pipeline.field.setup import spread, start_learning, training_scale
from pipeline.field.trainer import MAX_SAMPLES, DivergedError
from pipeline.field.volume_rendering import _place
from pipeline.kernels.volume_rendering import trace
from tests.field.scene import painted_scene

TRAIN = np.array([0, 1, 3, 4, 6, 7, 9, 10])
TINY = {
    "rays": 768,
    "frames_per_step": 3,
    "levels": 4,
    "features": 4,
    "log2_rows": 14,
    "hidden_width": 32,
    "finest_cell_px": 1.5,
    "margin_m": 0.04,
    "step_fraction": 0.012,
    "occupancy_start": 24,
    "occupancy_decay": 0.7,
    "border_px": 2,
}


@pytest.fixture(scope="module")
def scene():
    return painted_scene(12, 110)


def begin(scene, **options):
    config = FieldConfig(**(TINY | options))
    pictures = [(scene.images[row], scene.masks[row]) for row in TRAIN]
    return start_learning(scene.body, scene.motion.select(TRAIN), scene.camera, pictures, config)


def error_on(scene, learning, row):
    pose = canonical_to_world(scene.body, scene.motion.select(np.array([row])))[0]
    grid, skin = learning.occupancy.grid(), learning.scene.skin
    shown = over_white(render_field(learning.field, grid, scene.body, pose, scene.camera, skin))
    mask = torch.from_numpy(scene.masks[row])[..., None] / 255
    truth = torch.from_numpy(scene.images[row]) / 255 * mask + 1 - mask
    return -10 * float((shown - truth).square().mean().log10())


def test_learns_a_painted_body_and_shows_it_in_a_new_pose(scene):
    learning = begin(scene, steps=120, pose_refinement=False)
    shell = int(learning.occupancy.occupied.sum())
    before = error_on(scene, learning, 2)
    losses = [learning.step() for _ in range(120)]
    assert losses[-1]["colour"] < 0.3 * losses[0]["colour"]
    assert error_on(scene, learning, 2) > max(22.5, before + 5)
    assert int(learning.occupancy.occupied.sum()) < shell


def test_refinement_finds_a_shift_of_the_body(scene):
    wrong = scene.motion.root_translation_m + np.array([0.03, 0, 0], dtype=np.float32)
    moved = scene.motion.with_pose(scene.motion.rotations_wxyz, wrong)
    pictures = [(scene.images[row], scene.masks[row]) for row in TRAIN]
    # One frame alone is wrong: the others say where the body is.
    root = scene.motion.root_translation_m.copy()
    root[4] = moved.root_translation_m[4]
    motion = scene.motion.with_pose(scene.motion.rotations_wxyz, root).select(TRAIN)
    config = FieldConfig(**TINY, steps=220, pose_start=0.35, pose_rate=6e-3, pose_smoothness=0.0, pose_size=0.0)
    learning = start_learning(scene.body, motion, scene.camera, pictures, config)
    for _ in range(config.steps):
        learning.step()
    shift = learning.poses.shift_m.detach()
    assert float(shift[3, 0]) < -0.012
    assert float(shift[[0, 1, 2, 4, 5], 0].abs().max()) < 0.009


@pytest.mark.parametrize(("occupancy", "interrupted"), [("attention", 19), ("plain", 19), ("plain", 7)])
def test_a_resumed_run_ends_with_the_same_bytes(scene, occupancy, interrupted):
    """Step 7: poses are refined since step 6, and the first update of the cells comes with step 8."""
    options = {"steps": 30, "pose_start": 0.2, "occupancy": occupancy, "occupancy_start": 8}
    whole = begin(scene, **options)
    for _ in range(30):
        whole.step()
    first = begin(scene, **options)
    for _ in range(interrupted):
        first.step()
    kept = {name: value.clone() for name, value in first.state().items()}
    second = begin(scene, **options)
    second.load_state(kept)
    for _ in range(30 - interrupted):
        second.step()
    for name, value in whole.state().items():
        assert torch.equal(value, second.state()[name]), name


def test_poses_move_once_they_are_refined_and_samples_follow_them(scene):
    learning = begin(scene, steps=40, pose_start=0.25, occupancy_start=8)
    moved = []
    for _ in range(20):
        before = learning.poses.shift_m.detach().clone()
        learning.step()
        moved.append(not torch.equal(before, learning.poses.shift_m.detach()))
    assert [step for step, there in enumerate(moved) if there] == list(range(10, 20))
    assert 0 < len(learning.skin.nodes_m) < len(learning.scene.skin.nodes_m)
    batch = draw(learning, 0, 3)
    rays = Rays(batch.origins_m, batch.directions, batch.frame, batch.jitter)
    samples = learning.inverse.sample(rays, learning.step_m, learning.occupancy.grid(), MAX_SAMPLES)
    with torch.no_grad():
        still = _place(learning.inverse, rays, learning._placing(batch.frames), samples)
        learning.poses.shift_m += 0.01
        there = _place(learning.inverse, rays, learning._placing(batch.frames), samples)
    assert float((there - still).detach().norm(dim=1).median()) == pytest.approx(0.01 * 3**0.5, rel=0.3)


@pytest.mark.parametrize("frames_per_step", [3, 1])
def test_a_step_in_parts_comes_to_that_of_the_whole(scene, monkeypatch, frames_per_step):
    options = {"pose_start": 0.0, "occupancy_start": 4, "share_error": 0.6, "frames_per_step": frames_per_step}
    found = []
    # Which of the samples with small gradients stand for the others hangs on those before them.
    monkeypatch.setattr(look, "trace", partial(trace, thinning=0.0))
    for count in (1, 2):
        learning = begin(scene, steps=40, **options)
        for _ in range(6):
            learning.step()
        learning.part_count, gradients = count, {}
        monkeypatch.setattr(learning, "_update_parameters", lambda _, named, into=gradients: into.update(named))
        losses = learning.step()
        gradients["table"] = learning.table_gradient
        found.append((losses, gradients, learning.occupancy.reached, learning.errors.error))
    (losses, gradients, reached, errors), (part_losses, part_gradients, part_reached, part_errors) = found
    assert part_losses == pytest.approx(losses, rel=1e-5)
    assert set(gradients) == set(part_gradients) == {"table", "hidden", "output", "bias", "rotation_rad", "shift_m"}
    for name, gradient in gradients.items():
        assert (part_gradients[name] - gradient).norm() < 1e-4 * gradient.norm(), name
    assert torch.equal(reached, part_reached)
    np.testing.assert_allclose(errors, part_errors, rtol=1e-5)


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="one thread is all there is")
def test_the_number_of_threads_changes_no_byte(scene, monkeypatch):
    states = []
    for threads in (1, 2):
        monkeypatch.setattr(torch, "get_num_threads", lambda count=threads: count)
        learning = begin(scene, steps=40, pose_start=0.25, occupancy_start=8)
        assert (learning.threads._pool is None) == (threads == 1)
        for _ in range(16):
            learning.step()
        states.append(learning.state())
    for name, value in states[0].items():
        assert torch.equal(value, states[1][name]), name


def draw(learning, *frames):
    return learning._draw(np.array(frames))


def test_where_pixels_need_nothing_the_field_becomes_empty(scene):
    plain, asked = (begin(scene, steps=80, pose_refinement=False, unproven_points=count) for count in (0, 256))
    found = []
    for _ in range(80):
        plain.step()
        found.append(len(plain.occupancy.unproven))
        # Deep in the body no light comes: no pixel says what is there.
        deep = asked.occupancy.cells[asked.occupancy.distance_m < -0.03]
        asked.occupancy.unproven = deep
        asked.step()
    assert max(found) > 20
    assert set(found[:23]) == {0}
    points = plain.occupancy.points_in(deep, np.random.default_rng(0))
    assert len(points) > 200
    assert float(asked.field.density(points).mean()) < 0.8 * float(plain.field.density(points).mean())


def test_a_nan_never_reaches_a_parameter(scene):
    learning = begin(scene, steps=50, pose_refinement=False)
    learning.step()
    learning.field.hidden.data[0, 0] = float("nan")
    before = learning.field.table.detach().clone()
    for _ in range(19):
        learning.step()
    with pytest.raises(DivergedError, match="20 steps"):
        learning.step()
    assert torch.equal(learning.field.table.detach(), before)


def test_images_shrink_to_the_size_asked_for(scene):
    tall_px = scene.body.height_m() * scene.camera.fy / 3.0
    assert training_scale(scene.body, scene.motion, scene.camera, 1000) == 1.0
    assert training_scale(scene.body, scene.motion, scene.camera, round(tall_px / 2)) == pytest.approx(0.5, rel=0.02)


def test_spread_keeps_both_ends():
    assert spread(10, 4).tolist() == [0, 3, 6, 9]
    assert spread(3, 9).tolist() == [0, 1, 2]
