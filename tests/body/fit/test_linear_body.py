import numpy as np
import pytest
import torch

from pipeline.body.body import load_anny
from pipeline.body.fit.landmark_regressor import LANDMARK_COUNT, LANDMARK_OFFSET_COUNT, landmark_regressor
from pipeline.body.fit.linear_body import ACTIVE_JOINTS, LinearBody, linearise_body, reduced_parents
from pipeline.body.fit.posed_points import (
    pose_jacobian_rows,
    pose_points,
    pose_skeleton,
    shape_jacobian_rows,
    surface_points,
)
from pipeline.geometry.rotation import axis_angle_to_matrix
from pipeline.geometry.skinning import forward_kinematics, linear_blend_skinning, skinning_transforms

FRAMES = 2


@pytest.fixture(scope="module")
def model() -> LinearBody:
    body = load_anny()
    return linearise_body(body, body.shape_defaults)


def random_pose(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    angles = 0.4 * torch.randn(FRAMES, len(ACTIVE_JOINTS), 3, generator=generator, dtype=torch.float64)
    return axis_angle_to_matrix(angles), torch.randn(FRAMES, 3, generator=generator, dtype=torch.float64)


def test_posed_points_equal_linear_blend_skinning_of_the_whole_body(model: LinearBody) -> None:
    """Away from the fingers the reduced skeleton moves the surface as the 52 joints do."""
    body = load_anny()
    rotations, root = random_pose()
    full = model.all_joint_rotations(rotations)
    joints = model.full_joints_m
    vertices, _ = body.rest_pose(body.shape_defaults)
    transforms = skinning_transforms(forward_kinematics(full, root, joints, body.parents), joints)
    weights = torch.as_tensor(body.skin_weights).double()
    expected = linear_blend_skinning(vertices.double(), weights, transforms)
    fingers = [j for j, name in enumerate(body.joint_names) if "Hand" in name and not name.endswith("Hand")]
    without_fingers = torch.nonzero(weights[:, fingers].sum(1) == 0).squeeze(1)[::97]
    corners = without_fingers[None, :, None].expand(FRAMES, -1, 3)
    barycentric = torch.full(corners.shape, 1 / 3, dtype=torch.float64)
    world = pose_points(
        model, pose_skeleton(model, rotations, root), surface_points(model, corners, barycentric)
    ).world_m
    assert torch.allclose(world, expected[:, without_fingers], atol=1e-6)


def test_derivatives_agree_with_differences(model: LinearBody) -> None:
    regressor = landmark_regressor(model)
    offsets = torch.zeros(LANDMARK_OFFSET_COUNT, dtype=torch.float64)
    rotations, root = random_pose()
    generator = torch.Generator().manual_seed(1)
    point_gradient = torch.randn(FRAMES, LANDMARK_COUNT, 3, generator=generator, dtype=torch.float64)
    points = regressor.points(model, offsets)
    skeleton = pose_skeleton(model, rotations, root)
    posed = pose_points(model, skeleton, points)
    world, lever_arms = posed.world_m, posed.lever_arms_m

    step = 1e-5 * torch.randn(FRAMES, 3 * len(ACTIVE_JOINTS) + 3, generator=generator, dtype=torch.float64)
    turned = axis_angle_to_matrix(step[:, :-3].reshape(FRAMES, -1, 3)) @ rotations
    perspective_jacobian = torch.randn(FRAMES, 3, 3, generator=generator, dtype=torch.float64)
    moved_root = root + (perspective_jacobian @ step[:, -3:, None])[..., 0]
    moved = pose_points(model, pose_skeleton(model, turned, moved_root), points).world_m
    expected = ((moved - world) * point_gradient).sum(-1)
    rows = pose_jacobian_rows(skeleton, lever_arms, perspective_jacobian, point_gradient).double()
    assert torch.allclose((rows @ step[..., None])[..., 0], expected, atol=1e-8)

    shape_step = 1e-4 * torch.randn(len(model.shape), generator=generator, dtype=torch.float64)
    offset_step = 1e-4 * torch.randn(LANDMARK_OFFSET_COUNT, generator=generator, dtype=torch.float64)
    other = model.at_shape(model.shape + shape_step)
    moved = pose_points(other, pose_skeleton(other, rotations, root), regressor.points(other, offset_step)).world_m
    expected = ((moved - world) * point_gradient).sum(-1)
    rows = shape_jacobian_rows(model, skeleton, points, point_gradient).double()
    assert torch.allclose(rows @ torch.cat([shape_step, offset_step]), expected, atol=1e-8)


def test_linear_body_approximates_the_body(model: LinearBody) -> None:
    body = load_anny()
    shape = body.shape_defaults.clone()
    shape[body.shape_names.index("height")] += 0.05
    shape[body.shape_names.index("upperleg-length")] += 0.2
    exact = linearise_body(body, shape)
    approximate = model.at_shape(shape.double())
    assert (exact.vertices_m - approximate.vertices_m).abs().max() < 2e-3
    assert (exact.vertices_m - model.vertices_m).abs().max() > 2e-2
    height, gradient = model.height_m()
    assert height + float(gradient @ (shape.double() - model.shape)) == pytest.approx(exact.height_m()[0], abs=2e-3)


def test_foot_length_is_that_of_the_vertices_of_the_foot_and_follows_its_size(model: LinearBody) -> None:
    length_m, gradient = model.foot_length_m()
    feet_m = model.vertices_m[model.vertices_m[:, 1] < model.vertices_m[:, 1].min() + 0.03]
    left_m = feet_m[feet_m[:, 0] > 0.0][:, [0, 2]]
    assert length_m == pytest.approx(float(torch.cdist(left_m, left_m).max()), rel=0.03)
    step = torch.zeros_like(model.shape)
    step[load_anny().shape_names.index("foot-size")] = 0.3
    larger_m = model.at_shape(model.shape + step).foot_length_m()[0]
    assert larger_m > length_m + 0.01
    assert length_m + float(gradient @ step) == pytest.approx(larger_m, abs=1e-3)


def test_skin_weights_of_fingers_are_merged_into_the_hand(model: LinearBody) -> None:
    assert torch.allclose(
        model.skin_weights.sum(1), torch.ones(len(model.skin_weights), dtype=torch.float64), atol=1e-5
    )
    tip = int(model.vertices_m[:, 0].argmax())
    assert model.skin_weights[tip, ACTIVE_JOINTS.index("LeftHand")] > 0.99


def test_finger_rotations_bend_fingers_only(model: LinearBody) -> None:
    body = load_anny()
    angle = torch.linalg.matrix_norm(model.finger_rotations - torch.eye(3, dtype=torch.float64))
    bent = [name for name, bend in zip(body.joint_names, angle, strict=True) if bend > 1e-3]
    assert len(bent) == 24
    assert all("Hand" in name and "Thumb" not in name for name in bent)


def test_reduced_parents_skip_inactive_joints() -> None:
    parents = np.array([-1, 0, 1, 2, 1])
    assert reduced_parents(parents, [0, 2, 3, 4]) == (-1, 0, 1, 0)
