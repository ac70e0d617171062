"""A small synthetic scene with ground truth: a painted body that turns in front of a camera; options for tests."""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch

from pipeline.body.body import Body, Motion, canonical_to_world, load_anny
from pipeline.core.device import CPU
from pipeline.field.config import FieldConfig
from pipeline.field.ray_batches import RayBatch
from pipeline.field.settings import FieldSettings
from pipeline.field.setup import create_trainer
from pipeline.field.trainer import Trainer
from pipeline.geometry.camera import Camera
from pipeline.geometry.differentiable_raster import render_attributes
from pipeline.geometry.rotation import axis_angle_to_quaternion, quaternion_multiply
from pipeline.geometry.skinning import linear_blend_skinning

TRAIN = np.array([0, 1, 3, 4, 6, 7, 9, 10])
"""Frames of the scene that tests train on."""
TINY = {
    "rays_per_step": 768,
    "frames_per_step": 3,
    "levels": 4,
    "features_per_level": 4,
    "log2_hashmap_size": 14,
    "hidden_width": 32,
    "finest_cell_px": 1.5,
    "min_clothing_offset_m": 0.04,
    "step_fraction": 0.012,
    "occupancy_warmup_steps": 24,
    "occupancy_decay": 0.7,
    "border_px": 2,
}
"""Options and settings of a training of seconds."""
SETTING_NAMES = frozenset(setting.name for setting in fields(FieldSettings))


def field_config(**values: Any) -> FieldConfig:
    """Options and settings of the field by one set of names."""
    settings = {name: value for name, value in values.items() if name in SETTING_NAMES}
    options = {name: value for name, value in values.items() if name not in SETTING_NAMES}
    return FieldConfig(**options, settings=FieldSettings(**settings))


@dataclass(frozen=True)
class PaintedScene:
    body: Body
    motion: Motion
    camera: Camera
    colours: np.ndarray
    images: list[np.ndarray]
    masks: list[np.ndarray]


def make_motion(body: Body, frames: int, seed: int = 0, bend_rad: float = 0.08) -> Motion:
    """One full turn, 3 m in front of the camera, with small random rotations of all joints."""
    rng = torch.Generator().manual_seed(seed)
    bends = axis_angle_to_quaternion(torch.randn(frames, len(body.joint_names), 3, generator=rng) * bend_rad)
    angle = torch.arange(frames) * (2 * np.pi / frames)
    turn = axis_angle_to_quaternion(torch.stack([torch.zeros(frames), angle, torch.zeros(frames)], dim=-1))
    bends[:, 0] = quaternion_multiply(turn, bends[:, 0])
    root = np.tile(np.array([[0.0, float(body.joints_m[0, 1]) - 0.92, -3.0]], np.float32), (frames, 1))
    index = np.arange(frames, dtype=np.int32)
    return Motion(index, index.astype(np.float32) / 30, bends.numpy(), root)


def paint(vertices: np.ndarray) -> np.ndarray:
    """Vertex colours with detail at several scales: stripes and a checkerboard."""
    x, y, z = vertices.T
    skin = np.array([0.85, 0.65, 0.55]) + 0.1 * np.sin(30 * vertices)
    shirt = np.stack(
        [0.7 + 0.2 * np.sign(np.sin(60 * x) * np.sin(60 * y)), 0.15 + 0.1 * np.sin(20 * y), 0.2 + 0 * y], -1
    )
    trousers = np.stack([0.15 + 0 * y, 0.2 + 0.1 * np.sin(25 * x), 0.5 + 0.2 * np.sin(40 * y)], -1)
    colours = np.where(((y > 0.95) & (y < 1.45))[:, None], shirt, np.where((y <= 0.95)[:, None], trousers, skin))
    return np.clip(colours, 0, 1).astype(np.float32)


def painted_scene(frames: int, height_px: int, seed: int = 0, bend_rad: float = 0.08) -> PaintedScene:
    anny = load_anny()
    body = anny.at_shape(anny.shape_defaults)
    motion = make_motion(body, frames, seed, bend_rad)
    focal = 1.4 * height_px
    camera = Camera(focal, focal, height_px / 2, height_px / 2, height_px, height_px)
    colours = paint(body.vertices)
    posed = linear_blend_skinning(
        torch.from_numpy(body.vertices), torch.from_numpy(body.skin_weights), canonical_to_world(body, motion)
    )
    images, masks = [], []
    for vertices in posed:
        image, alpha = render_attributes(vertices, torch.from_numpy(body.faces), camera, torch.from_numpy(colours))
        straight = image / alpha.clamp(min=1e-3)[..., None]
        images.append((255 * straight.clamp(0, 1)).round().byte().numpy())
        masks.append((255 * alpha.clamp(0, 1)).round().byte().numpy())
    return PaintedScene(body, motion, camera, colours, images, masks)


def psnr_on_white_db(render: torch.Tensor, image: np.ndarray, mask: np.ndarray) -> float:
    """PSNR (dB) of a premultiplied render (h, w, 4) against an image and its mask, both on white."""
    alpha = torch.from_numpy(mask)[..., None] / 255
    target = torch.from_numpy(image) / 255 * alpha + 1 - alpha
    on_white = render[..., :3] + (1 - render[..., 3:])
    return -10 * float((on_white - target).square().mean().log10())


def make_trainer(scene: PaintedScene, device: torch.device = CPU, **options: Any) -> Trainer:
    """A trainer with the options `TINY` on the frames `TRAIN`."""
    config = field_config(**(TINY | options))
    masked_images = [(scene.images[row], scene.masks[row]) for row in TRAIN]
    return create_trainer(scene.body, scene.motion.select(TRAIN), scene.camera, masked_images, config, device)


def sample_rays(trainer: Trainer, *frames: int) -> RayBatch:
    """The rays of some frames in the present step."""
    return trainer.sampler.sample_rays(np.array(frames), trainer.completed_steps, trainer.inverse_skinning.cameras)
