"""A small synthetic scene with known truth: a painted body that turns before a camera."""

from dataclasses import dataclass

import numpy as np
import torch

from pipeline.body.body import Body, Motion, canonical_to_world, load_anny
from pipeline.geometry.camera import Camera
from pipeline.geometry.differentiable_raster import render_attributes
from pipeline.geometry.rotation import axis_angle_to_quaternion, quaternion_multiply
from pipeline.geometry.skinning import linear_blend_skinning


@dataclass(frozen=True)
class PaintedScene:
    body: Body
    motion: Motion
    camera: Camera
    colours: np.ndarray
    images: list[np.ndarray]
    masks: list[np.ndarray]


def make_motion(body: Body, frames: int, seed: int = 0, bend_rad: float = 0.08) -> Motion:
    """One full turn, 3 m before the camera, with small random bends of all joints."""
    random = torch.Generator().manual_seed(seed)
    bends = axis_angle_to_quaternion(torch.randn(frames, len(body.joint_names), 3, generator=random) * bend_rad)
    angle = torch.arange(frames) * (2 * np.pi / frames)
    turn = axis_angle_to_quaternion(torch.stack([torch.zeros(frames), angle, torch.zeros(frames)], dim=-1))
    bends[:, 0] = quaternion_multiply(turn, bends[:, 0])
    root = np.tile(np.array([[0.0, float(body.joints_m[0, 1]) - 0.92, -3.0]], np.float32), (frames, 1))
    index = np.arange(frames, dtype=np.int32)
    return Motion(index, index.astype(np.float32) / 30, bends.numpy(), root)


def paint(vertices: np.ndarray) -> np.ndarray:
    """Bands and a chequered chest: colours with detail at several scales."""
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
    body = anny.body(anny.shape_defaults)
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
