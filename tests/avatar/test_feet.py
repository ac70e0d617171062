"""Contacts and planting of feet on motions whose feet are known."""

import numpy as np
import pytest
import torch

from pipeline.avatar.feet import find_contacts, joint_positions_m, plant_feet, sole_positions_m
from pipeline.body.body import Body, Motion, canonical_to_world
from pipeline.geometry.rotation import axis_angle_to_quaternion

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
    assert max(slides_m(bare, planted, contact)) < 1e-4
    np.testing.assert_allclose(planted.rotations_wxyz[:, 0], motion.rotations_wxyz[:, 0], atol=1e-5)
    assert np.ptp(planted.root_translation_m[:, 0]) < 1e-3


def test_feet_that_slide_apart_are_held_by_the_legs(bare: Body) -> None:
    """Both thighs open: each foot slides outwards, so the hips cannot follow both."""
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
    assert max(slides_m(bare, planted, contact)) < 0.001
    joints = joint_positions_m(bare, planted)
    for start, end in (("LeftUpLeg", "LeftLeg"), ("LeftLeg", "LeftFoot")):
        a, b = bare.joint(start), bare.joint(end)
        length_m = np.linalg.norm(bare.joints_m[b] - bare.joints_m[a])
        np.testing.assert_allclose(np.linalg.norm(joints[:, b] - joints[:, a], axis=1), length_m, atol=1e-5)
    feet = [bare.joint("LeftFoot"), bare.joint("RightFoot")]
    before, after = (canonical_to_world(bare, m)[:, feet, :3, :3].numpy() for m in (opening, planted))
    np.testing.assert_allclose(after, before, atol=1e-5)


def test_feet_below_the_floor_are_raised(bare: Body) -> None:
    motion = standing(bare)
    sunk = motion.with_pose(motion.rotations_wxyz, motion.root_translation_m - np.float32([0, 0.05, 0]))
    planted = plant_feet(bare, sunk, np.zeros((30, 4), bool), 0.0)
    soles = [bare.joint(name) for name in ("LeftFoot", "LeftToeBase", "RightFoot", "RightToeBase")]
    assert (joint_positions_m(bare, planted)[:, soles, 1] > bare.joints_m[soles, 1] - 1e-4).all()
    np.testing.assert_allclose(planted.root_translation_m, sunk.root_translation_m, atol=1e-5)


def test_raised_and_fast_soles_do_not_stand() -> None:
    """Heel and ball of the right foot: in the air in the middle, and fast at the end; short gaps are closed."""
    time_s = np.arange(90) / FPS
    soles = np.zeros((90, 4, 3))
    soles[30:60, 2:, 1] = 0.2
    soles[10, 0, 1] = 0.2  # one frame of noise
    soles[60:, 3, 2] = np.linspace(0, 1.0, 30)
    contact = find_contacts(soles, time_s)
    assert contact[:, 0].all()
    assert contact[5:20, 2].all()
    assert not contact[35:55, 2:].any()
    assert contact[70:85, 2].all()
    assert not contact[65:85, 3].any()


def test_the_correction_does_not_jump_from_the_ankle_to_the_ball(bare: Body) -> None:
    motion = standing(bare)
    root_m = motion.root_translation_m + np.linspace(0, 0.06, 30)[:, None].astype(np.float32) * [0, 0, 1]
    contact = np.zeros((30, 4), bool)
    contact[:15, [0, 2]] = contact[15:, [1, 3]] = True
    planted = plant_feet(bare, motion.with_pose(motion.rotations_wxyz, root_m), contact, 0.0)
    steps_m = np.diff(sole_positions_m(bare, planted)[..., [0, 2]], axis=0)
    assert np.linalg.norm(steps_m, axis=2).max() < 1e-3
