"""Training on another device than the CPU: a CUDA GPU if there is one, and a fake device with the same rules."""

import sys
from contextlib import ExitStack, nullcontext
from unittest import mock

import numpy as np
import pytest
import torch

from pipeline.body.body import canonical_to_world
from pipeline.field.rendering import render_field
from pipeline.field.validation import Validator
from tests.fake_device import FAKE_DEVICE, fake_device
from tests.field.scene import make_trainer

FEW = {
    "rays_per_step": 256,
    "occupancy_warmup_steps": 4,
    "occupancy_update_interval": 4,
    "pose_start_fraction": 0.25,
    "steps": 24,
}
MAX_OPERATIONS = 1000
"""Tensor operations of a step with pose refinement; each is a kernel launch of about 5 microseconds on a GPU."""


def train(scene, device, steps, **options):
    trainer = make_trainer(scene, device, **(FEW | options))
    return trainer, [trainer.step() for _ in range(steps)]


def compare(scene, device, **options):
    """The first steps agree up to rounding, later ones in their colour loss."""
    steps = FEW["steps"]
    _, cpu_losses = train(scene, torch.device("cpu"), steps, **options)
    other, losses = train(scene, device, steps, **options)
    # On the CPU rays end at low transmittance; other devices evaluate all samples.
    cpu_samples, samples = cpu_losses[0].pop("samples"), losses[0].pop("samples")
    assert 0.99 * samples < cpu_samples <= samples
    for name, value in cpu_losses[0].items():
        assert losses[0][name] == pytest.approx(value, rel=2e-3, abs=1e-6), name
    assert losses[-1]["colour"] == pytest.approx(cpu_losses[-1]["colour"], rel=0.1)
    assert losses[-1]["colour"] < 0.8 * losses[0]["colour"]
    assert float(other.poses.shift_m.detach().abs().max()) > 0
    return other


@pytest.mark.parametrize(
    "options",
    [
        {},
        pytest.param({"occupancy": "attention"}, marks=pytest.mark.slow),
        pytest.param({"inverse_skinning": "nearest"}, marks=pytest.mark.slow),
    ],
)
def test_training_on_another_device_agrees_with_the_cpu(scene, options):
    with fake_device():
        compare(scene, FAKE_DEVICE, **options)


@pytest.mark.cuda
def test_training_on_a_gpu_agrees_with_the_cpu(scene, cuda):
    compare(scene, torch.device(cuda))


@pytest.mark.slow
def test_steps_with_cuda_kernels_in_the_simulator_agree_with_the_cpu(scene):
    """Without a GPU, tensors of the CPU stand for those of one; few, because each thread is one of Python."""
    few = {"rays_per_step": 64, "empty_points": 64, "unobserved_points": 8, "occupancy_warmup_steps": 99}
    # The second step refines the poses. Gradients averaged over frames cancel; Adam's first step is one of their sign.
    options = few | {"pose_start_fraction": 0.04, "pose_correlation_time_s": 0.0}
    cpu, expected = train(scene, torch.device("cpu"), 3, **options)
    with ExitStack() as patches:
        for module in [module for name, module in sys.modules.items() if name.startswith("pipeline.")]:
            if "runs_on_cuda" in vars(module):
                patches.enter_context(mock.patch.object(module, "runs_on_cuda", stands_for_cuda))
        patches.enter_context(mock.patch("pipeline.field.trainer.CPU_BATCH_PARTS", 1))
        patches.enter_context(mock.patch("pipeline.field.trainer.MAX_SAMPLES_PER_RAY", 40))
        simulated, losses = train(scene, torch.device("cpu"), 3, **options)
    for name, value in expected[0].items():
        if name != "samples":  # on the CPU rays end at low transmittance
            assert losses[0][name] == pytest.approx(value, rel=2e-3, abs=1e-6), name
    assert losses[2]["colour"] == pytest.approx(expected[2]["colour"], rel=0.02)
    # The first steps of Adam are signs of the gradient, which the CPU's subsampling changes where it is near zero.
    shift_m, cpu_shift_m = simulated.poses.shift_m.detach(), cpu.poses.shift_m.detach()
    assert float(cpu_shift_m.abs().max()) > 2e-4
    assert float(((shift_m - cpu_shift_m).abs() < 1e-4).float().mean()) > 0.8


def stands_for_cuda(*tensors: torch.Tensor) -> bool:
    return all(tensor.dtype == torch.float32 for tensor in tensors)


@pytest.fixture(scope="module", params=["fake", "cuda"])
def trained(request, scene):
    """A trainer on another device, inside the context of that device."""
    device = FAKE_DEVICE if request.param == "fake" else torch.device(request.getfixturevalue("cuda"))
    with fake_device() if device == FAKE_DEVICE else nullcontext() as calls:
        yield train(scene, device, 12)[0], calls


@pytest.mark.slow
def test_renders_and_checkpoints_return_to_the_cpu(scene, trained):
    trainer, _ = trained
    pose = canonical_to_world(scene.body, scene.motion.select(np.array([2])))[0]
    shown = render_field(trainer.field, trainer.occupancy.binary(), scene.body, pose, scene.camera)
    state = {name: value.cpu() for name, value in trainer.state_dict().items()}
    again = make_trainer(scene, **FEW)
    again.load_state_dict(state)
    here = render_field(again.field, again.occupancy.binary(), scene.body, pose, scene.camera)
    assert float(here[..., 3].amax()) > 0.5
    assert float((shown - here).abs().mean()) < 1e-4
    back = make_trainer(scene, trainer.device, **FEW)
    back.load_state_dict(state)
    assert back.completed_steps == trainer.completed_steps


def test_validation_with_refined_poses(scene, trained):
    trainer, _ = trained
    validator = Validator(
        scene.motion.select(np.array([2, 5])), scene.camera, [(scene.images[r], scene.masks[r]) for r in (2, 5)]
    )
    subsampled_validator = validator.subsampled()
    renders = subsampled_validator.render(trainer, subsampled_validator.pose_warps(trainer, refined=True))
    assert all(np.isfinite(score) for score in subsampled_validator.psnr_per_frame_db(renders))


@pytest.mark.slow
def test_a_step_has_few_operations(scene):
    with fake_device() as calls:
        trainer = make_trainer(scene, FAKE_DEVICE, **FEW)
        for _ in range(FEW["steps"] - 2):
            trainer.step()
        before = calls.count
        trainer.step()
        assert trainer.refines_poses
        assert 100 < calls.count - before < MAX_OPERATIONS


def test_the_fake_device_has_the_rules_of_a_gpu():
    with fake_device():
        there = torch.arange(6.0).to(FAKE_DEVICE)
        with pytest.raises(RuntimeError, match="is on the CPU"):
            there + torch.ones(6)
        with pytest.raises(RuntimeError, match="numpy"):
            there.numpy()
        leaf = torch.ones(3, device=FAKE_DEVICE, requires_grad=True)
        (leaf.square().sum() * 2.0).backward()
        assert leaf.grad.tolist() == [4.0, 4.0, 4.0]
        assert (there[2:4] + 1).cpu().tolist() == [3.0, 4.0]
