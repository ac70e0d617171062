"""A capsule that sways while its hand bends: true and disturbed poses, and pictures of the true ones."""

from dataclasses import replace

import numpy as np
import torch

from pipeline.body.body import Body, Motion, canonical_to_world
from pipeline.geometry.camera import Camera
from pipeline.geometry.rotation import axis_angle_to_quaternion, quaternion_multiply
from pipeline.mesh.skin_transfer import SkinnedTopology
from pipeline.mesh.views import PosedView, render_posed_view
from tests.mesh.egg import PATTERN

FRAMES = 7
JOINTS = 2
WORLD_TO_CAMERA = np.diag([1.0, -1.0, -1.0, 1.0]).astype(np.float32)
WORLD_TO_CAMERA[:3, 3] = [0.0, 0.5, 1.6]
CAMERA = Camera(330.0, 330.0, 100.0, 70.0, 200, 140, WORLD_TO_CAMERA)


def swaying_motion(body: Body) -> Motion:
    """The capsule sways about the vertical axis while the hand bends."""
    phase = np.linspace(0.0, 2.0, FRAMES)
    turns = np.zeros((FRAMES, JOINTS, 3), np.float32)
    turns[:, 0, 1], turns[:, 1, 2] = 0.4 * np.sin(phase), 0.5 * np.cos(phase)
    rotations = axis_angle_to_quaternion(torch.from_numpy(turns)).numpy()
    return Motion(np.arange(FRAMES, dtype=np.int32), phase / 4.0, rotations, np.tile(body.joints_m[:1], (FRAMES, 1)))


def render_views(body: Body, skin: SkinnedTopology, motion: Motion) -> list[PosedView]:
    blank = torch.zeros(CAMERA.height, CAMERA.width, dtype=torch.uint8)
    views = []
    for pose in canonical_to_world(body, motion):
        view = PosedView(blank[..., None].expand(-1, -1, 3), blank, CAMERA, pose)
        with torch.no_grad():
            image, alpha, _ = render_posed_view(torch.from_numpy(body.vertices), skin, view, PATTERN)
        straight = (image / alpha[..., None].clamp_min(1e-3)).clamp(0.0, 1.0)
        views.append(replace(view, image=(255 * straight).round().byte(), mask=(255 * alpha).round().byte()))
    return views


def disturbed(motion: Motion) -> tuple[Motion, np.ndarray, np.ndarray]:
    """Poses that are off by two degrees a joint and a centimetre, slowly changing; with the errors."""
    phase = np.linspace(0.3, 2.0, FRAMES)[:, None, None]
    turn_rad = np.radians(2.0) * np.sin(phase + np.arange(JOINTS * 3).reshape(1, JOINTS, 3))
    shift_m = 0.01 * np.sin(phase[:, :, 0] + np.arange(3)) * [1.0, 1.0, 0.3]
    turned = quaternion_multiply(
        torch.from_numpy(motion.rotations_wxyz), axis_angle_to_quaternion(torch.from_numpy(turn_rad).float())
    )
    return motion.with_pose(turned.numpy(), motion.root_translation_m + shift_m), turn_rad, shift_m
