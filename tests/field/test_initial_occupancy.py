from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from pipeline.body.body import Body
from pipeline.field.initial_occupancy import (
    cell_signed_distances_m,
    estimate_clothing_offset_m,
    field_bounds_m,
    initial_occupancy,
    observed_from_one_side,
    project_mask_fraction,
    skirt_reach_m,
)
from pipeline.field.occupancy import cell_centres
from pipeline.geometry.camera import Camera
from pipeline.geometry.surface import signed_distance_m
from tests.kernels.bar import bar_skin

DISC_M = 0.3
UPRIGHT = torch.eye(4).expand(1, 2, 4, 4)
LOOKING_BACK = np.diag([1.0, -1.0, -1.0, 1.0])
LOOKING_BACK[2, 3] = 2.0


def mask_fraction_of(points, distances, masks, width=40):
    """Mask fraction of points of the straight bar; the camera is 2 m away, and 0.1 m are five pixels."""
    camera = Camera(100.0, 100.0, width / 2, 20.0, width, 40, LOOKING_BACK.astype(np.float32))
    matrices = UPRIGHT.expand(len(masks), 2, 4, 4)
    points, distances = np.array(points, dtype=np.float32), np.array(distances, dtype=np.float32)
    weights = bar_skin().interpolate_weights(torch.from_numpy(points))
    return project_mask_fraction(points, distances, weights, matrices, camera, masks)


def test_mask_fraction_counts_the_masks_that_contain_a_point():
    left = np.zeros((40, 40), dtype=np.uint8)
    left[:, :20] = 1
    masks = [left, left, left, 1 - left]
    mask_fraction = mask_fraction_of([[-0.3, 0, 0], [0.3, 0, 0]], [0.1, 0.1], masks)
    np.testing.assert_allclose(mask_fraction, [0.75, 0.25], atol=1e-6)


def test_the_prior_of_unseen_points_is_high_near_the_body_only():
    masks = [np.ones((40, 20), dtype=np.uint8)] * 8
    seen, near, far = mask_fraction_of([[0, 0, 0], [0.5, 0, 0], [0.5, 0, 0]], [0.1, 0.0, 0.1], masks, width=20)
    assert seen == 1
    assert near == 1
    assert far == 0


def test_few_observations_of_a_far_point_do_not_outweigh_the_prior():
    masks = [np.ones((40, 40), dtype=np.uint8)] * 2
    blank = [np.zeros((40, 40), dtype=np.uint8)] * 2
    assert mask_fraction_of([[0, 0, 0]], [0.1], masks + blank)[0] == 0.5
    narrow = [np.ones((40, 40), dtype=np.uint8)] * 4
    assert mask_fraction_of([[0.42, 0, 0]], [0.1], narrow)[0] < 0.1


@pytest.mark.parametrize(("arc_deg", "one_sided"), [(0, True), (130, True), (160, False), (360, False)])
def test_a_bone_that_turns_more_than_145_degrees_is_not_one_sided(arc_deg, one_sided):
    """The mean direction over an arc a has the length sin(a/2) / (a/2): 0.75 at 145 degrees."""
    angle = torch.linspace(-0.5, 0.5, 73)[:-1] * np.radians(arc_deg)
    turning = torch.eye(4).repeat(len(angle), 1, 1)
    turning[:, 0, 0], turning[:, 0, 2] = angle.cos(), angle.sin()
    turning[:, 2, 0], turning[:, 2, 2] = -angle.sin(), angle.cos()
    matrices = torch.stack([torch.eye(4).repeat(len(angle), 1, 1), turning], dim=1)
    camera = Camera(100.0, 100.0, 20.0, 20.0, 40, 40, LOOKING_BACK.astype(np.float32))
    joints_m, weights = (
        np.zeros((2, 3), np.float32),
        bar_skin().interpolate_weights(torch.tensor([[-0.3, 0, 0], [0.3, 0, 0]])),
    )
    found = observed_from_one_side(joints_m, weights, matrices, camera)
    assert found.tolist() == [True, one_sided]
    # Position and initial orientation of the body do not matter.
    matrices[:, :, :3, 3] = torch.tensor([0.0, 0.0, -50.0])
    turned = torch.tensor([[0.0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]])
    again = observed_from_one_side(joints_m, weights, matrices @ turned, camera)
    assert again.tolist() == [True, one_sided]


def test_cells_have_their_signed_distance_up_to_the_maximum(body):
    bounds_m, max_distance_m = field_bounds_m(body, 0.1), 0.02
    some = np.random.default_rng(0).permutation(64**3)[:20_000]
    truth_m = signed_distance_m(cell_centres(bounds_m)[some], body.mesh())
    # The deepest cells are farther from all vertices than the bound of the query.
    assert truth_m.min() < -(max_distance_m + 0.06)
    found_m = cell_signed_distances_m(body, bounds_m, max_distance_m).reshape(-1)[some]
    np.testing.assert_allclose(found_m, np.minimum(truth_m, max_distance_m), atol=1e-6)


def test_initially_occupied_are_the_body_and_cells_in_enough_masks():
    distance = np.array([-0.01, 0.05, 0.05, 0.2])
    mask_fraction = np.array([0.0, 0.7, 0.5, 1.0])
    assert initial_occupancy(distance, mask_fraction, 0.1, 0.6).tolist() == [True, True, False, False]


def offset_of_discs(radii_m, min_offset_m=0.05, max_offset_m=1.0):
    """Clothing offset of a flat body, a disc 2 m from the camera, with a round mask per frame; a pixel is 1 cm."""
    grid = np.stack(np.meshgrid(*2 * [np.arange(-DISC_M, DISC_M + 0.01, 0.01)]), axis=-1).reshape(-1, 2)
    disc = grid[np.linalg.norm(grid, axis=1) <= DISC_M + 1e-6]
    vertices = np.pad(disc, ((0, 0), (0, 1))).astype(np.float32)
    nowhere = np.zeros((1, 3), dtype=np.float32)
    ones = np.ones((len(vertices), 1), dtype=np.float32)
    body = Body(("Hips",), np.array([-1]), nowhere, vertices, np.array([[0, 1, 2]]), ones, {})
    camera = Camera(200.0, 200.0, 80.0, 80.0, 160, 160, LOOKING_BACK.astype(np.float32))
    row, column = np.mgrid[:160, :160] + 0.5
    from_axis_m = np.hypot(row - 80, column - 80) / 100
    masks = [from_axis_m < radius for radius in radii_m]
    return estimate_clothing_offset_m(
        body, UPRIGHT[:, :1].expand(len(masks), 1, 4, 4), camera, masks, min_offset_m, max_offset_m
    )


def test_the_offset_is_twice_the_distance_of_the_masks():
    # 99 % of the area of a disc is within sqrt(0.99) of its radius.
    for radius in (0.4, 0.5, 0.7):
        assert offset_of_discs([radius]) == pytest.approx(2 * (np.sqrt(0.99) * radius - DISC_M), abs=0.02)


def test_the_offset_is_clamped():
    assert offset_of_discs([DISC_M]) == 0.05
    assert offset_of_discs([0.7], max_offset_m=0.4) == 0.4
    assert offset_of_discs([0.7], max_offset_m=0.0) == 0.05


def test_a_minority_of_wrong_or_empty_masks_does_not_change_the_offset():
    assert offset_of_discs([DISC_M, DISC_M, DISC_M, 0.75, 0.75]) == 0.05
    assert offset_of_discs([0.5, 0.0, 0.0, 0.0]) == offset_of_discs([0.5])
    assert offset_of_discs([0.0]) == 0.05


def test_with_a_skirt_the_offset_is_that_of_the_pixels_beside_it(body):
    """A mask that is 12 cm wider than the body at the hem, a small part of it, and 3 cm elsewhere."""
    low, far = replace(body, hem_m=0.45), LOOKING_BACK.copy()
    far[1, 3], far[2, 3] = 0.9, 50.0
    camera = Camera(5000.0, 5000.0, 100.0, 100.0, 200, 200, far.astype(np.float32))
    column, row = np.meshgrid(np.arange(200) + 0.5, np.arange(200) + 0.5)
    to_body_m = cKDTree(body.vertices[:, :2]).query(np.stack([column / 100 - 1.0, 1.9 - row / 100], axis=-1))[0]
    mask = to_body_m < np.where(np.abs(1.9 - row / 100 - 0.47) < 0.02, 0.12, 0.03)
    poses = torch.eye(4).expand(1, len(body.joint_names), 4, 4)
    offset_m = estimate_clothing_offset_m(low, poses, camera, [mask], 0.0, 1.0)
    assert 0.12 < offset_m < 2 * 0.12
    assert estimate_clothing_offset_m(body, poses, camera, [mask], 0.0, 1.0) < 0.12


def reach_of_a_cylinder(body, radius_m, arc_deg=360.0, max_reach_m=0.5):
    """Reach of an upright cylinder around the legs from a far camera, and the truth; a pixel is 1 cm."""
    body = replace(body, hem_m=0.45)
    angle = np.radians(arc_deg) * (np.arange(24) / 24 - 0.5)
    poses = torch.eye(4).repeat(24, len(body.joint_names), 1, 1)
    poses[..., 0, 0] = poses[..., 2, 2] = torch.from_numpy(np.cos(angle))[:, None]
    poses[..., 0, 2] = torch.from_numpy(np.sin(angle))[:, None]
    poses[..., 2, 0] = -poses[..., 0, 2]
    far = LOOKING_BACK.copy()
    far[1, 3], far[2, 3] = 0.9, 50.0
    camera = Camera(5000.0, 5000.0, 100.0, 100.0, 200, 200, far.astype(np.float32))
    mask = np.broadcast_to(np.abs(np.arange(200) + 0.5 - 100) < 100 * radius_m, (200, 200))
    grid = np.stack(np.meshgrid(*2 * [np.arange(-radius_m, radius_m, 0.02)]), axis=-1).reshape(-1, 2)
    grid = grid[np.linalg.norm(grid, axis=1) < radius_m]
    heights_m = np.arange(0.45, body.height_on_legs_m(0.0), 0.02)
    inside = np.concatenate([np.insert(grid, 1, height_m, axis=1) for height_m in heights_m])
    truth_m = cKDTree(body.vertices).query(inside)[0].max()
    return skirt_reach_m(body, poses, camera, [mask] * 24, max_reach_m, 0.95), truth_m


def test_a_skirt_reaches_as_far_as_masks_from_all_sides_contain_points(body):
    """Round cloth is farther from the legs in front of their gap than at the sides."""
    for radius_m in (0.3, 0.4):
        reach_m, truth_m = reach_of_a_cylinder(body, radius_m)
        assert truth_m > radius_m - 0.15
        assert reach_m == pytest.approx(truth_m, abs=0.04)
    assert reach_of_a_cylinder(body, 0.4, max_reach_m=0.15)[0] == pytest.approx(0.15, abs=0.01)
    assert reach_of_a_cylinder(body, 0.4, max_reach_m=0.0)[0] == 0.0


def test_one_side_tells_no_reach_of_a_skirt(body):
    assert reach_of_a_cylinder(body, 0.3, arc_deg=90.0)[0] is None


def test_without_a_hem_there_is_no_skirt(body):
    camera = Camera(100.0, 100.0, 20.0, 20.0, 40, 40, LOOKING_BACK.astype(np.float32))
    mask, poses = np.ones((40, 40), dtype=bool), torch.eye(4).expand(1, len(body.joint_names), 4, 4)
    assert skirt_reach_m(body, poses, camera, [mask], 0.5, 0.6) is None
