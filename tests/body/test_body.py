"""The built-in body: frame, anatomy, differentiability, bind pose."""

import numpy as np
import pytest
import torch

from pipeline.body.body import LOCAL_CHANGES, SCALE, AnnyBody, Body, Motion, canonical_to_world, load_anny
from pipeline.geometry.rotation import axis_angle_to_quaternion
from pipeline.geometry.skinning import linear_blend_skinning


@pytest.fixture(scope="module")
def parametric() -> AnnyBody:
    return load_anny()


@pytest.fixture(scope="module")
def body(parametric: AnnyBody) -> Body:
    return parametric.at_shape(parametric.shape_defaults)


def still(body: Body) -> Motion:
    identity = np.zeros((1, len(body.joint_names), 4), dtype=np.float32)
    identity[..., 0] = 1
    return Motion(np.array([0], dtype=np.int32), np.zeros(1, dtype=np.float32), identity, body.joints_m[:1])


def posed_vertices(body: Body, motion: Motion) -> np.ndarray:
    weights = torch.as_tensor(body.skin_weights)
    return linear_blend_skinning(torch.as_tensor(body.vertices), weights, canonical_to_world(body, motion))[0].numpy()


def test_frame_is_upright_and_faces_plus_z(body: Body) -> None:
    assert 1.5 < body.height_m() < 2.0
    assert abs(body.vertices[:, 1].min()) < 1e-5
    assert np.abs(body.joints_m[0, [0, 2]]).max() < 1e-6  # the root is above the origin
    assert body.joints_m[body.joint("Head"), 1] > body.joints_m[body.joint("Hips"), 1] > 0.8
    toe, ankle = body.joints_m[body.joint("LeftToeBase")], body.joints_m[body.joint("LeftFoot")]
    assert toe[2] > ankle[2] + 0.05  # toes point along +Z
    assert body.joints_m[body.joint("LeftHand"), 0] > 0.3  # facing +Z, the left hand is at +X


def test_identity_pose_is_the_bind_pose(body: Body) -> None:
    np.testing.assert_allclose(posed_vertices(body, still(body)), body.vertices, atol=1e-5)


def test_bending_one_knee_moves_that_shin_only(body: Body) -> None:
    motion = still(body)
    knee = body.joint("LeftLeg")
    rotations = motion.rotations_wxyz.copy()
    rotations[0, knee] = axis_angle_to_quaternion(torch.tensor([0.8, 0.0, 0.0])).numpy()
    moved = np.linalg.norm(
        posed_vertices(body, motion.with_pose(rotations, motion.root_translation_m)) - body.vertices, axis=1
    )
    left_foot = body.skin_weights[:, body.joint("LeftFoot")] > 0.9
    others = body.skin_weights[:, [knee, body.joint("LeftFoot"), body.joint("LeftToeBase")]].sum(1) == 0
    assert moved[left_foot].min() > 0.1
    assert moved[others].max() < 1e-5


def test_shape_is_differentiable(parametric: AnnyBody) -> None:
    shape = parametric.shape_defaults.clone().requires_grad_()
    vertices, _ = parametric.rest_pose(shape)
    vertices[:, 1].max().backward()
    assert shape.grad is not None
    assert torch.isfinite(shape.grad).all()
    assert shape.grad[parametric.shape_names.index("height")] > 0.05


@pytest.mark.parametrize("name", LOCAL_CHANGES)
def test_a_local_change_moves_the_surface(parametric: AnnyBody, body: Body, name: str) -> None:
    shape = parametric.shape_defaults.clone()
    shape[parametric.shape_names.index(name)] = 1.0
    assert np.linalg.norm(parametric.at_shape(shape).vertices - body.vertices, axis=1).max() > 0.005


def test_scale_enlarges_surface_and_skeleton(parametric: AnnyBody, body: Body) -> None:
    shape = parametric.shape_defaults.clone()
    shape[parametric.shape_names.index(SCALE)] = 1.2
    larger = parametric.at_shape(shape)
    np.testing.assert_allclose(larger.vertices, 1.2 * body.vertices, atol=1e-5)
    np.testing.assert_allclose(larger.joints_m, 1.2 * body.joints_m, atol=1e-5)


def test_weights_are_a_partition_of_unity(body: Body) -> None:
    np.testing.assert_allclose(body.skin_weights.sum(1), 1.0, atol=1e-5)
    assert body.skin_weights.min() >= 0
    assert all(parent < joint for joint, parent in enumerate(body.parents))


def test_body_mesh_is_closed(body: Body) -> None:
    assert body.mesh().is_watertight()


def test_several_rest_poses_equal_single_ones() -> None:
    anny = load_anny()
    shapes = anny.shape_defaults + torch.tensor([[0.0], [0.1], [-0.05]])
    for row, many in enumerate(zip(*anny.rest_poses(shapes), strict=True)):
        for found, single in zip(many, anny.rest_pose(shapes[row]), strict=True):
            torch.testing.assert_close(found, single, atol=2e-6, rtol=0.0)
