"""A small animated avatar for the tests of the exporters: a box with three joints that bends, turns and walks."""

import cv2
import numpy as np
import torch
import trimesh

from pipeline.avatar.gltf import SkinnedMesh
from pipeline.avatar.gltf_material import MaterialMaps
from pipeline.body.body import Body, Motion
from pipeline.geometry.camera import Camera
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.rotation import axis_angle_to_quaternion
from pipeline.geometry.skinning import top_k_weights

FRAME_RATE = 25.0


def sample_body() -> Body:
    """A 1.8 m column with joints at 0.9, 1.3 and 1.6 m and smooth weights."""
    box = trimesh.creation.box((0.4, 1.8, 0.3)).subdivide().subdivide()
    vertices = (box.vertices + [0.0, 0.9, 0.0]).astype(np.float32)
    joints_m = np.array([[0.0, 0.9, 0.0], [0.02, 1.3, 0.0], [0.0, 1.6, 0.05]], dtype=np.float32)
    closeness = np.exp(-((vertices[:, 1, None] - joints_m[:, 1]) ** 2) / 0.02)
    weights = (closeness / closeness.sum(axis=1, keepdims=True)).astype(np.float32)
    names, parents = ("Hips", "Spine", "Head"), np.array([-1, 0, 1], dtype=np.int32)
    return Body(names, parents, joints_m, vertices, box.faces.astype(np.int32), weights, {})


def sample_motion(frames: np.ndarray) -> Motion:
    """Turns by more than 180 degrees, so that a naive quaternion track would flip sign; the head does not move."""
    phase = torch.as_tensor(frames / max(frames.max(), 1), dtype=torch.float32)
    zero = torch.zeros_like(phase)
    hips = torch.stack([zero, 6.0 * phase, zero], dim=1)
    spine = torch.stack([0.8 * torch.sin(3.0 * phase), zero, 0.3 * phase], dim=1)
    rotations = axis_angle_to_quaternion(torch.stack([hips, spine, torch.zeros_like(hips)], dim=1))
    place = torch.stack([0.5 * phase, 0.9 + 0.02 * torch.cos(phase), -4.0 + 0.3 * phase], dim=1)
    times = (frames / FRAME_RATE).astype(np.float32)
    return Motion(frames.astype(np.int32), times, rotations.numpy(), place.numpy())


def sample_skinned_mesh(body: Body) -> tuple[SkinnedMesh, Mesh]:
    indices, weights = top_k_weights(body.skin_weights)
    pad = ((0, 0), (0, 4 - indices.shape[1]))
    uv = np.random.default_rng(0).uniform(size=(len(body.vertices), 2)).astype(np.float32)
    mesh = body.mesh()
    arrays = (np.pad(indices, pad), np.pad(weights, pad))
    return SkinnedMesh(mesh.vertices, mesh.vertex_normals(), uv, *arrays, mesh.faces), mesh


def sample_camera() -> Camera:
    return Camera(fx=900.0, fy=910.0, cx=330.0, cy=300.0, width=640, height=600)


def sample_maps() -> MaterialMaps:
    random = np.random.default_rng(1)
    return MaterialMaps(_png(random.integers(0, 255, (64, 64, 3))), _png(random.integers(0, 255, (64, 64, 4))))


def _png(pixels: np.ndarray) -> bytes:
    return cv2.imencode(".png", pixels.astype(np.uint8))[1].tobytes()
