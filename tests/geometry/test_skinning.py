"""Forward kinematics and skinning against closed forms and a loop over vertices and joints."""

import numpy as np
import pytest
import torch

from pipeline.geometry import skinning
from pipeline.geometry.rotation import axis_angle_to_matrix

JOINTS_M = torch.tensor([[0.0, 1.0, 0.0], [0.5, 1.0, 0.0], [1.0, 1.0, 0.0]])
PARENTS = [-1, 0, 1]


def quarter_turn_about_z() -> torch.Tensor:
    return axis_angle_to_matrix(torch.tensor([0.0, 0.0, torch.pi / 2]))


def test_bending_the_elbow_moves_the_hand_on_a_circle() -> None:
    rotations = torch.eye(3).repeat(1, 3, 1, 1)
    rotations[0, 1] = quarter_turn_about_z()
    pose = skinning.forward_kinematics(rotations, JOINTS_M[:1], JOINTS_M, PARENTS)
    torch.testing.assert_close(pose[0, 2, :3, 3], torch.tensor([0.5, 1.5, 0.0]))
    moved = skinning.skinning_transforms(pose, JOINTS_M)
    hand = torch.tensor([1.0, 1.0, 0.0, 1.0])
    torch.testing.assert_close((moved[0, 2] @ hand)[:3], torch.tensor([0.5, 1.5, 0.0]))


def test_skinning_agrees_with_a_loop() -> None:
    generator = torch.Generator().manual_seed(0)
    rotations = axis_angle_to_matrix(torch.randn(2, 3, 3, generator=generator))
    transforms = skinning.skinning_transforms(
        skinning.forward_kinematics(rotations, torch.randn(2, 3, generator=generator), JOINTS_M, PARENTS), JOINTS_M
    )
    vertices = torch.randn(5, 3, generator=generator)
    weights = torch.rand(5, 3, generator=generator)
    weights /= weights.sum(1, keepdim=True)
    fast = skinning.linear_blend_skinning(vertices, weights, transforms)
    for frame in range(2):
        for v in range(5):
            homogeneous = torch.cat([vertices[v], torch.ones(1)])
            slow = sum(weights[v, j] * (transforms[frame, j] @ homogeneous)[:3] for j in range(3))
            torch.testing.assert_close(fast[frame, v], slow, atol=1e-5, rtol=0)


def test_parents_must_come_before_their_children() -> None:
    with pytest.raises(ValueError, match="parents must come before"):
        skinning.forward_kinematics(torch.eye(3).repeat(1, 3, 1, 1), JOINTS_M[:1], JOINTS_M, [-1, 2, 0])


def test_top_k_keeps_the_largest_weights_and_dense_weights_is_its_inverse() -> None:
    weights = np.array([[0.5, 0.3, 0.2, 0.0, 0.0, 0.0], [0.1, 0.1, 0.2, 0.25, 0.3, 0.05]], dtype=np.float32)
    indices, kept = skinning.top_k_weights(weights, k=4)
    np.testing.assert_allclose(kept.sum(1), 1.0, atol=1e-6)
    assert indices[0, 3] == 0
    assert kept[0, 3] == 0
    np.testing.assert_array_equal(indices[1], [4, 3, 2, 0])
    dense = skinning.dense_weights(torch.as_tensor(indices), torch.as_tensor(kept), 6)
    np.testing.assert_allclose(dense[0].numpy(), weights[0], atol=1e-6)
