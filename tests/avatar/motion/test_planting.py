"""Planting of feet on motions whose answer is known, and on recorded clips."""

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.distance import pdist

from pipeline.avatar.motion import planting
from pipeline.avatar.motion.feet import find_contacts, joint_positions_m, sole_positions_m
from pipeline.avatar.motion.planting import plant_feet
from pipeline.avatar.motion.retarget import retarget_with_contacts
from pipeline.body.body import Body, Motion, canonical_to_world
from pipeline.geometry.rotation import axis_angle_to_quaternion
from pipeline.io.bvh import read_bvh

FPS = 30.0


def standing(body: Body, frames: int = 30) -> Motion:
    identity = np.tile(np.array([1, 0, 0, 0], np.float32), (frames, len(body.joint_names), 1))
    root_m = np.repeat(body.joints_m[:1], frames, axis=0)
    return Motion(np.arange(frames, dtype=np.int32), np.arange(frames) / FPS, identity, root_m)


def slides_m(body: Body, motion: Motion, contact: np.ndarray) -> list[float]:
    """Horizontal distance of the held sole of a foot from its mean, the largest of each contact."""
    soles, slides = sole_positions_m(body, motion), [0.0]
    for ankle in (0, 2):
        held = np.where(contact[:, ankle + 1], 1, np.where(contact[:, ankle], 0, -1))
        edges = np.r_[0, np.flatnonzero(np.diff(held)) + 1, len(held)]
        for first, end in zip(edges[:-1], edges[1:], strict=True):
            if held[first] >= 0:
                track = soles[first:end, ankle + held[first]][:, [0, 2]]
                slides.append(float(np.linalg.norm(track - track.mean(axis=0), axis=1).max()))
    return slides


def test_a_motion_whose_feet_stand_still_is_not_changed(bare: Body) -> None:
    motion = standing(bare)
    contact = find_contacts(sole_positions_m(bare, motion), motion.time_s)
    assert contact.all()
    planted = plant_feet(bare, motion, contact, 0.0)
    np.testing.assert_allclose(joint_positions_m(bare, planted), joint_positions_m(bare, motion), atol=1e-4)


def test_a_sliding_person_stands(bare: Body) -> None:
    """All joints move 3 cm to the side in a second, with feet that should stand: the hips stay with the feet."""
    motion = standing(bare)
    root_m = motion.root_translation_m + np.linspace(0, 0.03, 30)[:, None].astype(np.float32) * [1, 0, 0]
    sliding = motion.with_pose(motion.rotations_wxyz, root_m)
    contact = find_contacts(sole_positions_m(bare, sliding), motion.time_s)
    assert contact.all()
    planted = plant_feet(bare, sliding, contact, 0.0)
    assert max(slides_m(bare, sliding, contact)) == pytest.approx(0.015, abs=1e-4)
    assert max(slides_m(bare, planted, contact)) < 1e-3
    np.testing.assert_allclose(planted.rotations_wxyz, motion.rotations_wxyz, atol=1e-3)
    assert np.ptp(planted.root_translation_m[:, 0]) < 1e-3


def test_feet_that_slide_apart_are_held_by_the_legs(bare: Body) -> None:
    """Both thighs open: each foot slides outwards by 3 cm, so the hips cannot follow both."""
    motion = standing(bare)
    angles = np.zeros((30, len(bare.joint_names), 3))
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        angles[:, bare.joint(f"{side}UpLeg"), 2] = sign * np.linspace(0, 0.04, 30)
        angles[:, bare.joint(f"{side}Foot"), 2] = -sign * np.linspace(0, 0.04, 30)
    rotations = axis_angle_to_quaternion(torch.from_numpy(angles)).numpy().astype(np.float32)
    opening = motion.with_pose(rotations, motion.root_translation_m)
    contact = np.ones((30, 4), bool)
    assert max(slides_m(bare, opening, contact)) > 0.015
    planted = plant_feet(bare, opening, contact, 0.0)
    assert 0.001 < max(slides_m(bare, planted, contact)) < 0.005
    joints = joint_positions_m(bare, planted)
    for start, end in (("LeftUpLeg", "LeftLeg"), ("LeftLeg", "LeftFoot")):
        a, b = bare.joint(start), bare.joint(end)
        length_m = np.linalg.norm(bare.joints_m[b] - bare.joints_m[a])
        np.testing.assert_allclose(np.linalg.norm(joints[:, b] - joints[:, a], axis=1), length_m, atol=1e-5)
    feet = [bare.joint("LeftFoot"), bare.joint("RightFoot")]
    before, after = (canonical_to_world(bare, m)[:, feet, :3, :3].numpy() for m in (opening, planted))
    np.testing.assert_allclose(after, before, atol=1e-5)


def test_a_person_below_the_floor_rises_with_its_legs_as_they_are(bare: Body) -> None:
    motion = standing(bare)
    sunk = motion.with_pose(motion.rotations_wxyz, motion.root_translation_m - np.float32([0, 0.05, 0]))
    planted = plant_feet(bare, sunk, np.zeros((30, 4), bool), 0.0)
    soles = [bare.joint(name) for name in ("LeftFoot", "LeftToeBase", "RightFoot", "RightToeBase")]
    assert (joint_positions_m(bare, planted)[:, soles, 1] > bare.joints_m[soles, 1] - 1e-4).all()
    np.testing.assert_allclose(planted.root_translation_m, motion.root_translation_m, atol=1e-3)
    np.testing.assert_allclose(planted.rotations_wxyz, motion.rotations_wxyz, atol=2e-3)


def test_the_correction_does_not_jump_from_the_ankle_to_the_ball(bare: Body) -> None:
    motion = standing(bare)
    root_m = motion.root_translation_m + np.linspace(0, 0.06, 30)[:, None].astype(np.float32) * [0, 0, 1]
    contact = np.zeros((30, 4), bool)
    contact[:15, [0, 2]] = contact[15:, [1, 3]] = True
    planted = plant_feet(bare, motion.with_pose(motion.rotations_wxyz, root_m), contact, 0.0)
    steps_m = np.diff(sole_positions_m(bare, planted)[..., [0, 2]], axis=0)
    assert np.linalg.norm(steps_m, axis=2).max() < 1e-3


def leg_directions(body: Body, positions_m: np.ndarray) -> np.ndarray:
    """Unit vectors of both thighs and shins, (n, 4, 3)."""
    names = [(side + a, side + b) for side in ("Left", "Right") for a, b in (("UpLeg", "Leg"), ("Leg", "Foot"))]
    bones = np.stack([positions_m[:, body.joint(b)] - positions_m[:, body.joint(a)] for a, b in names], axis=1)
    return bones / np.linalg.norm(bones, axis=2, keepdims=True)


@pytest.mark.parametrize("name", ["cmu1_jumping_jacks", "fair1_zombie", "rokoko_jesse_dance"])
def test_planted_clips_keep_the_directions_of_legs_and_do_not_slide(name: str, bare: Body, shared_data: Path) -> None:
    """Within 2 degrees of the clip and 10 mm a contact; knees are not jerked."""
    clip = read_bvh(shared_data / "motions" / f"{name}.bvh")
    motion, contact = retarget_with_contacts(clip, bare, np.zeros(3), in_place=False)
    planted = plant_feet(bare, motion, contact, 0.0)
    before_m, after_m = joint_positions_m(bare, motion), joint_positions_m(bare, planted)
    cosine = (leg_directions(bare, before_m) * leg_directions(bare, after_m)).sum(axis=2)
    assert np.degrees(np.arccos(cosine.clip(-1.0, 1.0))).max() < 2.0
    soles = sole_positions_m(bare, planted)
    for sole in range(4):
        edges = np.r_[0, np.flatnonzero(np.diff(contact[:, sole])) + 1, len(contact)]
        for first, end in zip(edges[:-1], edges[1:], strict=True):
            is_held = contact[first, sole] and (sole % 2 == 1 or not contact[first:end, sole + 1].any())
            if is_held and end - first > 1:
                assert pdist(soles[first:end, sole][:, [0, 2]]).max() < 0.01
    knees = [bare.joint("LeftLeg"), bare.joint("RightLeg")]
    before, after = (
        np.percentile(np.linalg.norm(np.diff(m[:, knees], 2, axis=0), axis=2), 99.9) for m in (before_m, after_m)
    )
    assert after < 1.5 * before
    world = [canonical_to_world(bare, m)[..., :3, :3].numpy() for m in (motion, planted)]
    pelvis_cosine = 0.5 * (np.einsum("nab,nab->n", world[0][:, 0], world[1][:, 0]) - 1.0)
    assert np.degrees(np.arccos(pelvis_cosine.clip(-1.0, 1.0))).max() < 6.0


def random_legs(frames: int) -> planting._Legs:
    random = np.random.default_rng(0)
    down = np.tile([0.0, -0.4, 0.0], (frames, 2, 1))
    lateral = np.tile([1.0, 0.0, 0.0], (frames, 2, 1))
    thigh_m, shin_m = (down + random.uniform(-0.15, 0.15, down.shape) for _ in range(2))
    return planting._Legs(thigh_m, shin_m, random.uniform(-0.1, 0.1, down.shape), lateral)


def test_legs_that_are_not_moved_keep_their_directions_also_backward_knees() -> None:
    legs = random_legs(200)
    assert (np.cross(legs.thigh_m, legs.shin_m)[..., 0] < 0.0).any()
    found = legs.bent(np.zeros((200, 2, 3))).reshape(200, 2, 2, 3)
    for row, bone_m in enumerate((legs.thigh_m, legs.shin_m)):
        length_m = np.linalg.norm(bone_m, axis=2, keepdims=True)
        np.testing.assert_allclose(found[:, :, row], bone_m / length_m, atol=1e-6)


def test_bent_legs_end_where_their_ankles_go() -> None:
    legs = random_legs(200)
    shift_m = np.random.default_rng(1).uniform(-0.03, 0.03, (200, 2, 3)) + [0.0, 0.05, 0.0]
    found = legs.bent(shift_m).reshape(200, 2, 2, 3)
    lengths_m = [np.linalg.norm(bone, axis=2, keepdims=True) for bone in (legs.thigh_m, legs.shin_m)]
    ankle_m = lengths_m[0] * found[:, :, 0] + lengths_m[1] * found[:, :, 1]
    np.testing.assert_allclose(ankle_m, legs.thigh_m + legs.shin_m + shift_m, atol=1e-6)


def test_the_linearised_cost_has_the_gradient_of_the_cost() -> None:
    """Central differences of the sum of squares, unknown by unknown."""
    legs, random = random_legs(3), np.random.default_rng(2)
    unknowns = random.normal(0.0, 0.01, (3, 12)) + np.tile([0.0, -0.03, 0.0], 4) * np.repeat([1, 0, 0, 0], 3)
    bones = legs.bent(np.zeros((3, 2, 3)))

    def cost(values: np.ndarray) -> float:
        error = legs.residuals(legs.ankle_shift_m(values))
        error[..., :6] -= bones
        own = planting._PELVIS_COST**2 * (values[:, 3:6] ** 2).sum() + planting._DAMPING**2 * (values**2).sum()
        return float(0.5 * (error**2).sum() + 0.5 * own)

    hessian, gradient = planting._linearised(legs, bones, unknowns)
    found = np.einsum("nij,nj->ni", hessian, unknowns) + gradient
    steps = np.eye(36).reshape(36, 3, 12) * 1e-5
    expected = np.array([(cost(unknowns + step) - cost(unknowns - step)) / 2e-5 for step in steps]).reshape(3, 12)
    np.testing.assert_allclose(found, expected, atol=0.02 * np.abs(expected).max())


def test_the_normal_equations_are_those_of_dense_matrices() -> None:
    random, frames, step_s = np.random.default_rng(3), 6, 0.04
    root = random.normal(size=(frames, 12, 12))
    hessian, penalty = root @ root.transpose(0, 2, 1), random.uniform(size=(frames, 12))
    second = np.zeros((frames - 2, frames))
    for row in range(frames - 2):
        second[row, row : row + 3] = np.array([1.0, -2.0, 1.0]) / step_s**2
    scale = np.diag([1.0] * 3 + [planting._PELVIS_RADIUS_M] * 3 + [1.0] * 6) * planting._ACCELERATION_COST
    dense = np.kron(second, scale).T @ np.kron(second, scale) + np.diag(penalty.ravel())
    for frame in range(frames):
        block = slice(12 * frame, 12 * frame + 12)
        dense[block, block] += hessian[frame]
    band = planting._banded(hessian, penalty, step_s)
    for below in range(36):
        np.testing.assert_allclose(band[below, : 72 - below], np.diagonal(dense, -below), rtol=1e-9, atol=1e-12)


def test_clips_of_one_and_two_frames_are_planted(bare: Body) -> None:
    for frames in (1, 2):
        planted = plant_feet(bare, standing(bare, frames), np.ones((frames, 4), bool), 0.1)
        np.testing.assert_allclose(planted.root_translation_m[:, 1], bare.joints_m[0, 1] + 0.1, atol=2e-3)
