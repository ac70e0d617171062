"""The training: convergence, pose refinement, resumption, and independence of threads and parts."""

from functools import partial

import numba
import numpy as np
import pytest
import torch

from pipeline.body.body import canonical_to_world
from pipeline.capture.frame_selection import evenly_spaced
from pipeline.field import field as field_module
from pipeline.field import volume_rendering
from pipeline.field.losses import field_losses
from pipeline.field.optimiser import DivergedError
from pipeline.field.ray_batches import POINT_STREAM, STEP_STREAM, step_rng
from pipeline.field.rendering import render_field
from pipeline.field.setup import create_trainer, training_scale
from pipeline.field.trainer import MAX_SAMPLES_PER_RAY, Trainer
from pipeline.field.volume_rendering import sample_positions
from pipeline.kernels.hashgrid import FeatureGradients, add_table_gradient_
from pipeline.kernels.volume_rendering import RenderSettings
from tests.field.scene import TINY, TRAIN, field_config, make_trainer, psnr_on_white_db, sample_rays


def psnr_db(scene, trainer, row):
    pose = canonical_to_world(scene.body, scene.motion.select(np.array([row])))[0]
    grid, skin = trainer.occupancy.binary(), trainer.scene.skin
    render = render_field(trainer.field, grid, scene.body, pose, scene.camera, skin)
    return psnr_on_white_db(render, scene.images[row], scene.masks[row])


def test_learns_a_painted_body_and_renders_it_in_a_new_pose(scene):
    trainer = make_trainer(scene, steps=120, pose_refinement=False)
    initially_occupied = int(trainer.occupancy.occupied.sum())
    before = psnr_db(scene, trainer, 2)
    losses = [trainer.step() for _ in range(120)]
    assert losses[-1]["colour"] < 0.3 * losses[0]["colour"]
    assert psnr_db(scene, trainer, 2) > max(22.5, before + 5)
    assert int(trainer.occupancy.occupied.sum()) < initially_occupied


@pytest.mark.slow
def test_refinement_finds_a_shift_of_the_body(scene):
    wrong = scene.motion.root_translation_m + np.array([0.03, 0, 0], dtype=np.float32)
    moved = scene.motion.with_pose(scene.motion.rotations_wxyz, wrong)
    masked_images = [(scene.images[row], scene.masks[row]) for row in TRAIN]
    # Only one frame is wrong; the others determine the position of the body, so that gradients must not be averaged.
    root = scene.motion.root_translation_m.copy()
    root[4] = moved.root_translation_m[4]
    motion = scene.motion.with_pose(scene.motion.rotations_wxyz, root).select(TRAIN)
    config = field_config(
        **TINY,
        steps=220,
        pose_start_fraction=0.35,
        pose_learning_rate=6e-3,
        pose_correlation_time_s=0.0,
        pose_smoothness_weight=0.0,
        pose_l2_weight=0.0,
    )
    trainer = create_trainer(scene.body, motion, scene.camera, masked_images, config)
    for _ in range(config.steps):
        trainer.step()
    shift = trainer.poses.shift_m.detach()
    assert float(shift[3, 0]) < -0.012
    assert float(shift[[0, 1, 2, 4, 5], 0].abs().max()) < 0.009


@pytest.mark.parametrize(
    ("occupancy", "interrupted"),
    [
        pytest.param("attention", 19, marks=pytest.mark.slow),
        pytest.param("plain", 19, marks=pytest.mark.slow),
        ("plain", 7),
    ],
)
def test_a_resumed_training_ends_with_the_same_bytes(scene, occupancy, interrupted):
    """Step 7: the pose refinement started with step 6, and the first occupancy update follows with step 8."""
    options = {"steps": 30, "pose_start_fraction": 0.2, "occupancy": occupancy, "occupancy_warmup_steps": 8}
    whole = make_trainer(scene, **options)
    for _ in range(30):
        whole.step()
    first = make_trainer(scene, **options)
    for _ in range(interrupted):
        first.step()
    kept = {name: value.clone() for name, value in first.state_dict().items()}
    second = make_trainer(scene, **options)
    second.load_state_dict(kept)
    for _ in range(30 - interrupted):
        second.step()
    for name, value in whole.state_dict().items():
        assert torch.equal(value, second.state_dict()[name]), name


def test_poses_move_once_they_are_refined_and_samples_follow(scene):
    trainer = make_trainer(scene, steps=40, pose_start_fraction=0.25, occupancy_warmup_steps=8)
    moved = []
    for _ in range(20):
        before = trainer.poses.shift_m.detach().clone()
        trainer.step()
        moved.append(not torch.equal(before, trainer.poses.shift_m.detach()))
    assert [step for step, has_moved in enumerate(moved) if has_moved] == list(range(10, 20))
    assert 0 < len(trainer.inverse_skinning.skin.nodes_m) < len(trainer.scene.skin.nodes_m)
    batch, baked = sample_rays(trainer, 0, 3), trainer.inverse_skinning
    grid = trainer.occupancy.binary()
    samples = baked.inverse.sample_rays(batch.rays, trainer.step_m, grid, MAX_SAMPLES_PER_RAY)
    with torch.no_grad():
        before = sample_positions(baked.inverse, batch.rays, baked.pose_batch(batch.frame_indices), samples)
        trainer.poses.shift_m += 0.01
        after = sample_positions(baked.inverse, batch.rays, baked.pose_batch(batch.frame_indices), samples)
    assert float((after - before).detach().norm(dim=1).median()) == pytest.approx(0.01 * 3**0.5, rel=0.3)


@pytest.mark.parametrize("frames_per_step", [3, 1])
def test_parts_of_a_step_add_up_to_the_whole(scene, monkeypatch, frames_per_step):
    options = {
        "pose_start_fraction": 0.0,
        "occupancy_warmup_steps": 4,
        "error_sampling_ratio": 0.6,
        "frames_per_step": frames_per_step,
    }
    found = []
    # The subsampling of small gradients depends on the order of the samples.
    monkeypatch.setattr(volume_rendering, "RenderSettings", partial(RenderSettings, gradient_subsampling_threshold=0.0))
    for count in (1, 2):
        trainer = make_trainer(scene, steps=40, **options)
        for _ in range(6):
            trainer.step()
        trainer.part_count, gradients = count, {}
        monkeypatch.setattr(
            trainer.optimiser, "step", lambda _, by_name, is_finite, into=gradients: into.update(by_name)
        )
        losses = trainer.step()
        gradients["table"] = trainer.optimiser.grad_table
        found.append((losses, gradients, trainer.occupancy.max_transmittance, trainer.sampler.error_map.error))
    (
        (losses, gradients, max_transmittance, error_map),
        (part_losses, part_gradients, part_max_transmittance, part_errors),
    ) = found
    assert part_losses == pytest.approx(losses, rel=1e-5)
    assert set(gradients) == set(part_gradients) == {"table", "hidden", "output", "bias", "rotation_rad", "shift_m"}
    for name, gradient in gradients.items():
        assert (part_gradients[name] - gradient).norm() < 1e-4 * gradient.norm(), name
    assert torch.equal(max_transmittance, part_max_transmittance)
    np.testing.assert_allclose(error_map, part_errors, rtol=1e-5)


def reference_step(trainer: Trainer) -> tuple[dict[str, float], dict[str, torch.Tensor]]:
    """Losses and gradients of the next step: all rays at once, by torch operations and autograd."""
    seed, step, settings = trainer.config.seed, trainer.completed_steps, trainer.config.settings
    frames = trainer.sampler.sample_frames(step_rng(seed, step, STEP_STREAM))
    counts = settings.empty_points, settings.unobserved_points
    empty_m = trainer.occupancy.sample_empty_points(*counts, step_rng(seed, step, POINT_STREAM))
    batch = trainer.sampler.sample_rays(frames, step, trainer.inverse_skinning.cameras)
    poses, features = trainer.inverse_skinning.pose_batch(batch.frame_indices), FeatureGradients()
    limits = trainer.step_m, MAX_SAMPLES_PER_RAY
    found = volume_rendering.render_rays_dense(trainer.posed_field(), batch.rays, poses, empty_m, *limits, features)
    targets = batch.rgba, batch.background, batch.inlier_weight, found.density_per_m, settings
    losses, _ = field_losses(found.image, found.alpha, *targets)
    total = torch.stack(list(losses.values())).sum() + trainer._pose_loss()
    gradients = trainer.optimiser.gradients(total) | {"table": torch.zeros_like(trainer.field.table)}
    add_table_gradient_(gradients["table"], features, trainer.field.layout)
    return {name: float(loss.detach()) for name, loss in losses.items()}, gradients


def test_a_compiled_step_equals_the_composition_of_torch_operations(scene, monkeypatch):
    """Losses and gradients of a whole step, without early termination and subsampling."""
    exact = partial(RenderSettings, min_transmittance=0.0, gradient_subsampling_threshold=0.0)
    monkeypatch.setattr(volume_rendering, "RenderSettings", exact)
    monkeypatch.setattr(field_module, "MIN_RELATIVE_GRADIENT", 0.0)
    trainer, gradients = make_trainer(scene, steps=40, pose_start_fraction=0.0, occupancy_warmup_steps=4), {}
    for _ in range(6):
        trainer.step()
    expected_losses, expected_gradients = reference_step(trainer)
    monkeypatch.setattr(trainer.optimiser, "step", lambda _, by_name, is_finite: gradients.update(by_name))
    losses = trainer.step()
    gradients["table"] = trainer.optimiser.grad_table
    assert {name: losses[name] for name in expected_losses} == pytest.approx(expected_losses, rel=1e-4)
    assert set(gradients) == {"table", "hidden", "output", "bias", "rotation_rad", "shift_m"}
    for name, gradient in expected_gradients.items():
        assert float((gradients[name] - gradient).norm()) < 2e-3 * float(gradient.norm()), name


@pytest.mark.parametrize("occupancy", ["plain", "attention"])
def test_a_compiled_step_has_the_gradients_of_autograd(scene, occupancy):
    options = {"pose_start_fraction": 0.0, "occupancy_warmup_steps": 4, "occupancy": occupancy}
    trainer = make_trainer(scene, steps=40, **options)
    for _ in range(6):
        trainer.step()
    frames, empty_m = np.array([1, 3, 4]), trainer.occupancy.sample_empty_points(40, 40, np.random.default_rng(0))
    batch = trainer.sampler.sample_rays(frames, trainer.completed_steps, trainer.inverse_skinning.cameras)
    (poses,) = trainer.inverse_skinning.pose_batch(batch.frame_indices).split([3])
    arguments = (trainer.posed_field(), batch, empty_m, 0.4, poses)
    found, expected = (
        step(*arguments) for step in (trainer._forward_backward_compiled, trainer._forward_backward_autograd)
    )
    assert torch.equal(found.rendered.image, expected.rendered.image)
    assert torch.equal(found.colour_error, expected.colour_error)
    assert found.losses.keys() == expected.losses.keys() == {"colour", "alpha", "hard", "density"}
    for name, loss in expected.losses.items():
        torch.testing.assert_close(found.losses[name], loss, rtol=1e-5, atol=0)
    gradients = [result.gradients | {"poses": result.pose_gradient} for result in (found, expected)]
    assert gradients[0].keys() == gradients[1].keys() >= {"hidden", "output", "bias", "poses"}
    for name, gradient in gradients[1].items():
        assert float(gradient.norm()) > 0
        assert float((gradients[0][name] - gradient).norm()) < 1e-3 * float(gradient.norm()), name


@pytest.mark.slow
@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="this machine has one thread")
def test_results_do_not_depend_on_thread_count(scene, monkeypatch):
    states = []
    for threads in (1, 2):
        monkeypatch.setattr(torch, "get_num_threads", lambda count=threads: count)
        trainer = make_trainer(scene, steps=40, pose_start_fraction=0.25, occupancy_warmup_steps=8)
        assert (trainer.threads._pool is None) == (threads == 1)
        for _ in range(16):
            trainer.step()
        states.append(trainer.state_dict())
    for name, value in states[0].items():
        assert torch.equal(value, states[1][name]), name


@pytest.mark.slow
def test_unobserved_cells_lose_their_density(scene):
    plain, penalised = (
        make_trainer(scene, steps=80, pose_refinement=False, unobserved_points=count) for count in (0, 256)
    )
    found = []
    for _ in range(80):
        plain.step()
        found.append(len(plain.occupancy.unobserved))
        # No ray reaches cells deep in the body.
        deep = penalised.occupancy.candidate_cells[penalised.occupancy.distance_m < -0.03]
        penalised.occupancy.unobserved = deep
        penalised.step()
    assert max(found) > 20
    assert set(found[:23]) == {0}
    points = plain.occupancy.sample_in_cells(deep, np.random.default_rng(0))
    assert len(points) > 200
    assert float(penalised.field.density(points).mean()) < 0.8 * float(plain.field.density(points).mean())


def test_a_nan_never_reaches_a_parameter(scene):
    trainer = make_trainer(scene, steps=50, pose_refinement=False)
    trainer.step()
    trainer.field.hidden.data[0, 0] = float("nan")
    before = trainer.field.table.detach().clone()
    for _ in range(19):
        trainer.step()
    with pytest.raises(DivergedError, match="20 steps"):
        trainer.step()
    assert torch.equal(trainer.field.table.detach(), before)


def test_images_are_downscaled_to_the_height_of_the_person(scene):
    tall_px = scene.body.height_m() * scene.camera.fy / 3.0
    assert training_scale(scene.body, scene.motion, scene.camera, 1000) == 1.0
    assert training_scale(scene.body, scene.motion, scene.camera, round(tall_px / 2)) == pytest.approx(0.5, rel=0.02)


def test_evenly_spaced_includes_both_ends():
    assert evenly_spaced(10, 4).tolist() == [0, 3, 6, 9]
    assert evenly_spaced(3, 9).tolist() == [0, 1, 2]


def test_the_samples_of_the_next_step_are_counted_without_taking_it(scene):
    trainer = make_trainer(scene, steps=40, pose_refinement=False, occupancy_warmup_steps=8)
    for _ in range(12):
        trainer.step()
    before = {name: value.clone() for name, value in trainer.state_dict().items()}
    count = trainer.count_samples()
    assert all(torch.equal(value, before[name]) for name, value in trainer.state_dict().items())
    assert trainer.step()["samples"] == count > 0
