"""Projection of skinned vertices: against linear blend skinning and the camera, and against its definition in torch."""

import numpy as np
import pytest
import torch

from pipeline.geometry.camera import Camera, project
from pipeline.geometry.rotation import axis_angle_to_matrix
from pipeline.geometry.skinning import linear_blend_skinning, rigid_transform
from pipeline.kernels.blend import SparseWeights
from pipeline.kernels.skinned_projection import project_skinned
from pipeline.kernels.skinned_projection.reference import project_skinned as reference

CAMERA = Camera(300.0, 310.0, 120.0, 140.0, 240, 280)
INTRINSICS_PX = (300.0, 310.0, 120.0, 140.0)


def skinned_points(count: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Points (count, 3) around the origin, weights of 7 joints with two or three influences, matrices 3 m away."""
    random = torch.Generator().manual_seed(count)
    weights = torch.rand(count, 7, generator=random)
    weights[weights < weights.topk(3).values[:, -1:]] = 0
    weights[::2] = torch.where(weights[::2] == weights[::2].amax(1, keepdim=True), 0.0, weights[::2])
    weights /= weights.sum(1, keepdim=True)
    rotations = axis_angle_to_matrix(0.4 * torch.randn(7, 3, generator=random))
    shifts_m = 0.2 * torch.randn(7, 3, generator=random) + torch.tensor([0.0, 0.0, -3.0])
    return torch.randn(count, 3, generator=random), weights, rigid_transform(rotations, shifts_m)


def to_camera(matrices: torch.Tensor) -> torch.Tensor:
    return torch.from_numpy(np.asarray(CAMERA.world_to_camera, dtype=np.float32)) @ matrices


@pytest.mark.parametrize("count", [1, 15, 333])
def test_positions_equal_skinning_followed_by_projection(count: int) -> None:
    vertices, weights, matrices = skinned_points(count)
    expected = project(linear_blend_skinning(vertices, weights, matrices[None])[0], CAMERA)
    found = project_skinned(vertices, SparseWeights.from_dense(weights), to_camera(matrices), INTRINSICS_PX)
    for mine, theirs in zip(found, expected, strict=True):
        torch.testing.assert_close(mine, theirs, atol=1e-3, rtol=1e-5)


def test_values_and_gradients_equal_the_definition() -> None:
    vertices, weights, matrices = skinned_points(101)
    random = torch.Generator().manual_seed(5)
    upstream = torch.randn(101, 2, generator=random), torch.randn(101, generator=random)
    upstream[0][7], upstream[1][7] = 0.0, 0.0  # a vertex without a gradient
    results = []
    for dtype, project_vertices in ((torch.float32, project_skinned), (torch.float64, reference)):
        leaf = vertices.to(dtype).requires_grad_()
        sparse, moved = SparseWeights.from_dense(weights.to(dtype)), to_camera(matrices).to(dtype)
        moved = moved if project_vertices is project_skinned else moved[:, :3].reshape(-1, 12)
        projected = project_vertices(leaf, sparse, moved, INTRINSICS_PX)
        loss = sum((values * weight.to(dtype)).sum() for values, weight in zip(projected, upstream, strict=True))
        results.append((*(values.detach().double() for values in projected), *torch.autograd.grad(loss, leaf)))
    for mine, theirs in zip(*results, strict=True):
        torch.testing.assert_close(mine.double(), theirs, atol=1e-3, rtol=1e-4)
    assert not results[0][2][7].any()


def test_poses_have_gradients_too() -> None:
    vertices, weights, matrices = skinned_points(20)
    leaf = to_camera(matrices).requires_grad_()
    project_skinned(vertices, SparseWeights.from_dense(weights), leaf, INTRINSICS_PX)[0].sum().backward()
    assert leaf.grad is not None
    assert leaf.grad[:, :3].abs().sum() > 0
