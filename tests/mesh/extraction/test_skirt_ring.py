"""The ring of a skirt: a back that no frame shows is as far off as the sides, and what frames tell stays."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipeline.body.body import Body
from pipeline.geometry.camera import Camera
from pipeline.geometry.rotation import axis_angle_to_matrix
from pipeline.mesh.extraction.evidence import NORMALS, RingEvidence, ring_evidence
from pipeline.mesh.extraction.skirt_ring import complete_skirt
from pipeline.mesh.views import PosedView
from tests.mesh.extraction.two_legs import LEG_RADIUS_M, LEG_X_M, TRUNK_RADIUS_M, leg_grid

HEM_M, WIDENING_M, ARM_X_M = 0.2, 0.06, 0.28
ANGLE_RAD = 2.0 * np.pi * np.arange(NORMALS) / NORMALS
FRONT, BACK = 0, NORMALS // 2
CAMERA = Camera(600.0, 600.0, 80.0, 60.0, 160, 120)


def body_with_an_arm() -> Body:
    """Only what is nearest to the arm matters: a stick at the right, as high as the skirt."""
    height_m = np.linspace(0.0, 0.6, 25)
    sticks = [np.stack([np.full(25, x), height_m, np.zeros(25)], axis=1) for x in (-LEG_X_M, LEG_X_M, ARM_X_M)]
    return Body(
        joint_names=("Hips", "LeftArm"),
        parents=np.array([-1, 0], dtype=np.int32),
        joints_m=np.zeros((2, 3), dtype=np.float32),
        vertices=np.concatenate(sticks).astype(np.float32),
        faces=np.array([[0, 1, 2]], dtype=np.int32),
        skin_weights=np.repeat(np.eye(2, dtype=np.float32), (50, 25), axis=0),
        shape={},
    )


def skirt_m(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Signed distance to a skirt around both legs, from the hem on."""
    return np.maximum(np.hypot(x, z) - TRUNK_RADIUS_M - WIDENING_M * np.clip((0.5 - y) / 0.3, 0.0, 1.0), HEM_M - y)


def from_one_side() -> RingEvidence:
    """Outlines of both sides, and depth in front."""
    outline = (np.abs(np.sin(ANGLE_RAD)) > 0.9).astype(float)
    return RingEvidence(outline, np.clip(0.5 + np.cos(ANGLE_RAD), 0.0, 1.0))


def radius_m(distance_m: np.ndarray, z: np.ndarray, column: int, row: int) -> tuple[float, float]:
    """How far the solid reaches backwards and forwards in a row."""
    inside = z[column, row][distance_m[column, row] < 0.0]
    return float(-inside.min()), float(inside.max())


def test_a_back_that_collapsed_is_as_far_off_as_the_sides() -> None:
    grid, (x, y, z) = leg_grid(hem_m=HEM_M, spacing_m=0.01)
    true_m = np.minimum(grid.body_distance_m, skirt_m(x, y, z))
    collapsed_m = np.maximum(true_m, np.where(y < 0.5, -LEG_RADIUS_M - z, -1.0))
    completed = complete_skirt(collapsed_m, grid, body_with_an_arm(), from_one_side())
    column = grid.middle()
    for height_m in (0.25, 0.35):
        row = grid.row(height_m)
        truth, before, after = (
            radius_m(distance_m, z, column, row) for distance_m in (true_m, collapsed_m, completed.distance_m)
        )
        assert before[0] < truth[0] - 0.1
        assert after[0] == pytest.approx(truth[0], abs=0.015)
        assert after[1] == before[1]
    # Depth that frames tell stays to the bit, and so does what is below the hem.
    told = (completed.share == 0.0) | (y < HEM_M - 0.02)
    np.testing.assert_array_equal(completed.distance_m[told], collapsed_m[told])
    assert completed.share[column, grid.row(0.3), -1] == 0.0
    assert completed.share[column, grid.row(0.3), 0] == 1.0


def test_a_hem_that_moves_from_frame_to_frame_is_as_wide_as_the_skirt_above_it() -> None:
    """Over 6 cm it narrows to the legs where no depth is told; what frames tell of the front stays narrow."""
    grid, (x, y, z) = leg_grid(hem_m=HEM_M, spacing_m=0.01)
    cone_m = np.hypot(x, z) - TRUNK_RADIUS_M - WIDENING_M * np.clip((0.5 - y) / 0.3, 0.0, 1.0)
    rounding_m = 0.08 * np.clip((HEM_M + 0.06 - y) / 0.06, 0.0, 1.0)
    surface_m = np.minimum(grid.body_distance_m, cone_m + rounding_m)
    surface_m = np.where(y < HEM_M, grid.body_distance_m, surface_m)
    after_m = complete_skirt(surface_m, grid, body_with_an_arm(), from_one_side()).distance_m
    column, above, at_hem = grid.middle(), grid.row(HEM_M + 0.08), grid.row(HEM_M + 0.01)
    assert radius_m(surface_m, z, column, at_hem)[0] < radius_m(surface_m, z, column, above)[0] - 0.02
    assert radius_m(after_m, z, column, at_hem)[0] > radius_m(after_m, z, column, above)[0] - 0.011
    assert radius_m(after_m, z, column, at_hem)[1] == radius_m(surface_m, z, column, at_hem)[1]


def test_a_bulge_in_front_whose_depth_is_not_told_goes() -> None:
    grid, (x, y, z) = leg_grid(hem_m=HEM_M, spacing_m=0.01)
    true_m = np.minimum(grid.body_distance_m, skirt_m(x, y, z))
    bulge_m = np.maximum(np.maximum(np.abs(x) - 0.06, np.abs(y - 0.3) - 0.05), np.maximum(z - 0.19, -z))
    narrow = np.minimum(grid.body_distance_m, np.maximum(skirt_m(x, y, z), z - 0.1))
    evidence = replace(from_one_side(), depth=np.zeros(NORMALS))
    after_m = complete_skirt(np.minimum(narrow, bulge_m), grid, body_with_an_arm(), evidence).distance_m
    row = grid.row(0.3)
    found = [radius_m(after_m, z, grid.middle() + offset, row)[1] for offset in (0, 8)]
    truth = [radius_m(true_m, z, grid.middle() + offset, row)[1] for offset in (0, 8)]
    np.testing.assert_allclose(found, np.minimum(truth, 0.2), atol=0.015)


def test_arms_beside_a_skirt_stay() -> None:
    grid, (x, y, z) = leg_grid(hem_m=HEM_M, spacing_m=0.01)
    arm_m = np.hypot(x - ARM_X_M, z) - 0.02
    surface_m = np.minimum(np.minimum(grid.body_distance_m, skirt_m(x, y, z)), arm_m)
    after_m = complete_skirt(surface_m, grid, body_with_an_arm(), from_one_side()).distance_m
    assert (after_m[arm_m < 0.0] < 0.0).all()
    without_arm = complete_skirt(
        np.where(arm_m < 0.01, 0.01, surface_m), grid, body_with_an_arm(), from_one_side()
    ).distance_m
    far = arm_m > 0.05
    np.testing.assert_allclose(after_m[far], without_arm[far], atol=1e-9)


def test_without_a_hem_or_with_all_depths_told_nothing_changes() -> None:
    grid, coordinates = leg_grid(hem_m=HEM_M, spacing_m=0.01)
    surface_m, told = skirt_m(*coordinates), RingEvidence(np.ones(NORMALS), np.ones(NORMALS))
    for of_grid, evidence in ((replace(grid, hem_m=None), from_one_side()), (grid, told)):
        completed = complete_skirt(surface_m, of_grid, body_with_an_arm(), evidence)
        assert completed.distance_m is surface_m
        assert not completed.share.any()


def view_from(angle_rad: float) -> PosedView:
    """The body, turned about the vertical axis before a camera that looks along -Z."""
    turn = torch.eye(4)
    turn[:3, :3] = axis_angle_to_matrix(torch.tensor([0.0, angle_rad, 0.0]))
    turn[:3, 3] = torch.tensor([0.0, 0.0, -3.0])
    blank = torch.zeros(CAMERA.height, CAMERA.width, dtype=torch.uint8)
    return PosedView(blank[..., None].expand(-1, -1, 3), blank, CAMERA, turn.expand(2, 4, 4))


def test_a_turn_tells_all_depths_and_a_standing_person_none() -> None:
    body = body_with_an_arm()
    turn = ring_evidence(body, [view_from(angle) for angle in np.linspace(0.0, 2.0 * np.pi, 40, endpoint=False)])
    assert turn.depth.min() == 1.0
    standing = ring_evidence(body, [view_from(angle) for angle in np.linspace(-0.05, 0.05, 9)])
    assert standing.depth.max() == 0.0
    side = NORMALS // 4
    assert standing.outline[[side, 3 * side]].min() == 1.0
    assert standing.outline[[FRONT, BACK]].max() == 0.0


def test_the_side_that_the_camera_sees_has_the_depth() -> None:
    """A person who turns by 60 degrees to both sides, facing the camera or with the back to it."""
    swing = np.linspace(-1.05, 1.05, 40)
    for away_rad, seen, hidden in ((0.0, FRONT, BACK), (np.pi, BACK, FRONT)):
        evidence = ring_evidence(body_with_an_arm(), [view_from(angle + away_rad) for angle in swing])
        assert evidence.depth[seen] > 0.8
        assert evidence.depth[hidden] == 0.0
