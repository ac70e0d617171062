"""The optimiser of the field's training, apart from any image: poses under gradients of a few frames a step."""

import numpy as np
import torch

from pipeline.body.pose_correction import PoseCorrection
from pipeline.field.field import RadianceField, hash_grid_layout
from pipeline.field.optimiser import FieldOptimiser
from tests.field.scene import field_config, make_motion

FRAMES, STEPS, FRAMES_PER_STEP = 60, 600, 4
NOISE = 2.0
"""Standard deviation of a frame's gradient, over the root mean square of the true one."""


def errors_after_training(body, wanted_rad, correlation_time_s):
    """Learn the first angle of the hips from noisy gradients of the squared error; return its rms error, rad."""
    poses = PoseCorrection(body, make_motion(body, FRAMES))
    config = field_config(steps=STEPS, pose_start_fraction=0.0, pose_correlation_time_s=correlation_time_s)
    bounds_m = np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]], np.float32)
    field = RadianceField(bounds_m, hash_grid_layout(bounds_m, 0.5, 1, 2, 8), 8)
    optimiser = FieldOptimiser(field, poses, {}, config)
    rng, scale = np.random.default_rng(0), wanted_rad.square().mean().sqrt()
    for step in range(STEPS):
        shown = rng.choice(FRAMES, FRAMES_PER_STEP, replace=False)
        gradient = torch.zeros_like(poses.rotation_rad)
        difference = poses.rotation_rad.detach()[shown, 0, 0] - wanted_rad[shown]
        gradient[shown, 0, 0] = difference + NOISE * scale * torch.from_numpy(rng.normal(size=FRAMES_PER_STEP)).float()
        optimiser.step(step, {"rotation_rad": gradient}, is_finite=True)
    return (poses.rotation_rad.detach()[:, 0, 0] - wanted_rad).square().mean().sqrt()


def test_errors_that_change_slowly_are_learnt_from_few_noisy_frames_a_step(body):
    """An error of 3 degrees that comes and goes twice in two seconds; each frame is shown in every fifteenth step."""
    wanted_rad = np.radians(3.0) * torch.sin(torch.linspace(0.0, 4.0 * np.pi, FRAMES))
    start = wanted_rad.square().mean().sqrt()
    averaged, alone = (errors_after_training(body, wanted_rad, time_s) for time_s in (0.25, 0.0))
    assert averaged < 0.45 * start
    assert averaged < 0.75 * alone
