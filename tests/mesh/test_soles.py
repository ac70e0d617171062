"""Soles are laid level; posed meshes and the poses of the field stay as they were."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipeline.body.body import Body, Motion, canonical_to_world, load_anny
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.rotation import axis_angle_to_matrix, axis_angle_to_quaternion
from pipeline.geometry.skinning import linear_blend_skinning
from pipeline.mesh.soles import FEET, LevelSoles, resting_normal
from tests.mesh.capsule import capsule_body

TILTS_RAD = ((0.15, 0.0, -0.2), (-0.1, 0.0, 0.12))
"""Of the left and the right foot about x, y, z."""


@pytest.fixture(scope="module")
def body() -> Body:
    """Soles are flat: 2 cm of the feet are cut off."""
    anny = load_anny()
    bare = anny.at_shape(anny.shape_defaults)
    flat_m = bare.vertices.copy()
    flat_m[:, 1] = np.maximum(flat_m[:, 1], 0.02)
    return replace(bare, vertices=flat_m)


def sole_tilt_deg(mesh: Mesh, body: Body, side: int) -> float:
    weights = body.skin_weights[:, [body.joint(name) for name in FEET[side]]].sum(axis=1)
    normal = resting_normal(mesh.vertices[weights > 0.6])
    assert normal is not None
    return float(np.degrees(np.arccos(normal[1])))


def tilted(body: Body) -> Mesh:
    """The body with feet that were turned about their ankles."""
    tilts = LevelSoles(axis_angle_to_matrix(torch.tensor(TILTS_RAD).double()).numpy())
    return tilts.turn_mesh(body.mesh(), torch.from_numpy(body.skin_weights), body)


def swaying(body: Body) -> Motion:
    random = np.random.default_rng(3)
    turns = torch.from_numpy(random.normal(0.0, 0.2, (4, len(body.joint_names), 3)))
    turns[:, [body.joint(toes) for _, toes in FEET]] *= 0.1
    root_m = random.normal(0.0, 1.0, (4, 3)).astype(np.float32)
    return Motion(np.arange(4), np.arange(4) / 10.0, axis_angle_to_quaternion(turns).float().numpy(), root_m)


def motion_of_feet(body: Body, turns_rad: np.ndarray) -> Motion:
    """The A-pose with turned ankles, left and right."""
    turns = torch.zeros(5, len(body.joint_names), 3)
    turns[:, [body.joint(ankle) for ankle, _ in FEET]] = torch.from_numpy(turns_rad).float()
    root_m = np.tile(body.joints_m[:1], (5, 1))
    return Motion(np.arange(5), np.arange(5) / 10.0, axis_angle_to_quaternion(turns).numpy(), root_m)


def test_a_box_rests_on_its_lower_face() -> None:
    x, y, z = np.meshgrid(np.linspace(-0.04, 0.04, 5), (0.0, 0.06), np.linspace(-0.1, 0.15, 9))
    points_m = np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)
    rotation = axis_angle_to_matrix(torch.tensor([[0.1, 0.3, -0.2]]).double())[0].numpy()
    np.testing.assert_allclose(resting_normal(points_m @ rotation.T), rotation[:, 1], atol=1e-6)
    rough_m = points_m + np.random.default_rng(0).uniform(-0.001, 0.001, points_m.shape)
    assert np.degrees(np.arccos((resting_normal(rough_m) @ [0.0, 1.0, 0.0]).clip(-1.0, 1.0))) < 0.6
    assert resting_normal(points_m[y.ravel() == 0.0]) is None
    assert resting_normal(points_m[:2]) is None


def test_tilted_feet_are_laid_level_and_posed_as_before(body: Body) -> None:
    mesh, weights, motion = tilted(body), torch.from_numpy(body.skin_weights), swaying(body)
    soles = LevelSoles.of(mesh, weights, body, motion_of_feet(body, -np.array(TILTS_RAD)))
    level, turned = soles.turn_mesh(mesh, weights, body), soles.turn_motion_back(motion, body)
    before, after = (canonical_to_world(body, poses) for poses in (motion, turned))
    posed = [
        linear_blend_skinning(torch.from_numpy(surface.vertices).float(), weights, poses)
        for surface, poses in ((mesh, before), (level, after))
    ]
    for side, names in enumerate(FEET):
        assert sole_tilt_deg(mesh, body, side) > 8.0
        assert sole_tilt_deg(level, body, side) < 0.5
        of_foot = (weights[:, [body.joint(name) for name in names]].sum(dim=1) > 0.999).numpy()
        np.testing.assert_allclose(posed[1][:, of_foot], posed[0][:, of_foot], atol=0.002)
    far = np.abs(body.vertices[:, 1]) > 0.3
    np.testing.assert_allclose(level.vertices[far], mesh.vertices[far], atol=1e-6)
    np.testing.assert_allclose(posed[1][:, far], posed[0][:, far], atol=1e-5)
    ankles = [body.joint(ankle) for ankle, _ in FEET]
    np.testing.assert_allclose((after @ soles.transforms(body))[:, ankles], before[:, ankles], atol=1e-5)


def test_bodies_without_feet_are_left_alone() -> None:
    capsule = capsule_body()
    still = Motion(
        np.arange(1), np.zeros(1), np.tile(np.eye(4, dtype=np.float32)[:1], (1, 2, 1)), np.zeros((1, 3), np.float32)
    )
    none = LevelSoles.of(capsule.mesh(), torch.from_numpy(capsule.skin_weights), capsule, still)
    np.testing.assert_array_equal(none.rotations, LevelSoles().rotations)
    np.testing.assert_array_equal(none.transforms(capsule), np.tile(np.eye(4), (2, 1, 1)))
    assert none.turn_motion_back(still, capsule).rotations_wxyz.tolist() == still.rotations_wxyz.tolist()


def test_feet_are_turned_by_what_sole_and_motion_both_tell(body: Body) -> None:
    """The left foot leans to one side in the mesh and to the other where it stands; later both stand on their toes."""
    mesh, weights = tilted(body), torch.from_numpy(body.skin_weights)
    standing = motion_of_feet(body, np.array([(-0.1, 0.0, -0.1), (-TILTS_RAD[1][0], 0.0, -TILTS_RAD[1][2])]))
    left, right = LevelSoles.of(mesh, weights, body, standing).rotations
    np.testing.assert_allclose(left @ left.T, np.eye(3), atol=1e-6)
    pitch_rad, roll_rad = np.arctan2(left[2, 1], left[1, 1]), np.arctan2(-left[0, 1], left[1, 1])
    assert pitch_rad == pytest.approx(-0.1, abs=0.01)
    assert roll_rad == pytest.approx(0.0, abs=0.01)
    assert np.degrees(np.arccos(right[1, 1])) > 7.0
    on_toes = motion_of_feet(body, np.array([(0.6, 0.0, 0.0), (0.6, 0.0, 0.0)]))
    np.testing.assert_array_equal(LevelSoles.of(mesh, weights, body, on_toes).rotations, LevelSoles().rotations)
