"""A body in the shape of a capsule, and densities around it, for the tests of extraction and remeshing."""

import numpy as np
import torch
from torch import Tensor

from pipeline.body.body import Body
from pipeline.geometry.surface import isosurface
from pipeline.mesh.settings import MeshSettings

VOXEL_SIZE_M = 0.02
SETTINGS = MeshSettings(solid_core_depth_m=0.05)
BOUNDS_M = np.array([[-0.5, 0.25, -0.25], [0.55, 0.75, 0.25]])
"""A box that holds the densities of this file."""
RADIUS_M = 0.1


def capsule_distance(points: np.ndarray, low_x: float = -0.25, high_x: float = 0.3) -> np.ndarray:
    along = np.clip(points[..., 0], low_x, high_x)
    nearest = np.stack([along, np.full_like(along, 0.5), np.zeros_like(along)], axis=-1)
    return np.linalg.norm(points - nearest, axis=-1)


def capsule_body() -> Body:
    """A horizontal capsule of radius 0.1 m with two joints; the end at positive x is a hand."""
    axis = np.arange(-0.45, 0.5001, 0.025)
    points = np.stack(np.meshgrid(axis, axis + 0.5, axis, indexing="ij"), axis=-1)
    mesh = isosurface(RADIUS_M - capsule_distance(points), 0.0, np.array([axis[0], axis[0] + 0.5, axis[0]]), 0.025)
    hand_weight = np.clip((mesh.vertices[:, 0] - 0.0) / 0.1, 0.0, 1.0)
    return Body(
        joint_names=("Hips", "RightHand"),
        parents=np.array([-1, 0], dtype=np.int32),
        joints_m=np.array([[0.0, 0.5, 0.0], [0.05, 0.5, 0.0]], dtype=np.float32),
        vertices=mesh.vertices,
        faces=mesh.faces,
        skin_weights=np.stack([1.0 - hand_weight, hand_weight], axis=1).astype(np.float32),
        shape={},
    )


def shell_density(points: Tensor) -> Tensor:
    """A hollow shell around 0.14 m from the axis, with a floater; it also surrounds the hand."""
    distance = torch.from_numpy(capsule_distance(points.numpy().astype(np.float64)))
    density = torch.where((distance - 0.11).abs() < 0.03, 300.0, 0.0)
    floater = (points - torch.tensor([-0.25, 0.5, 0.2])).norm(dim=1) < 0.03
    return torch.where(floater, 300.0, density).float()
