"""The turn covers all headings, keeps the feet on the ground and has a natural sway."""

import numpy as np
import pytest
import torch

from data_tools.synthetic.scene.motion import (
    NOVEL_POSES,
    add_joint_angles,
    bend_at_hips,
    novel_motion,
    posture,
    snap_feet_to_floor,
    turn_in_a_pose,
)
from pipeline.avatar.motion.feet import lowest_foot_offset_m
from pipeline.body.body import Body, Motion, canonical_to_world
from pipeline.geometry.rotation import quaternion_to_matrix

GROUND_M = np.array([0.3, -0.9, -3.5])


@pytest.fixture(scope="module")
def turn(bare: Body) -> Motion:
    return turn_in_a_pose(bare, 48, 24.0, GROUND_M, seed=0)


def headings(motion: Motion) -> np.ndarray:
    """Heading of the hips, radians about +Y from +Z."""
    front = quaternion_to_matrix(torch.from_numpy(motion.rotations_wxyz[:, 0]))[:, :, 2].numpy()
    return np.arctan2(front[:, 0], front[:, 2])


def test_one_full_turn_in_even_steps(turn: Motion) -> None:
    angles = np.unwrap(headings(turn))
    assert abs(angles[0]) < 0.1  # towards the camera
    assert angles[-1] - angles[0] == pytest.approx(2 * np.pi * 47 / 48, abs=0.1)
    steps = np.diff(angles)
    assert steps.min() > 0.5 * 2 * np.pi / 48
    assert steps.max() < 1.5 * 2 * np.pi / 48


def test_lowest_foot_is_on_the_ground(bare: Body, turn: Motion) -> None:
    assert np.allclose(lowest_foot_offset_m(bare, turn), GROUND_M[1], atol=1e-5)


def test_person_stays_in_place(bare: Body, turn: Motion) -> None:
    assert np.allclose(turn.root_translation_m[:, [0, 2]], GROUND_M[[0, 2]], atol=1e-5)
    assert np.ptp(turn.root_translation_m[:, 1]) < 0.03


def test_sway_is_natural(bare: Body, turn: Motion) -> None:
    """Joints except the root stay within 9 degrees of the A-pose and move smoothly; the arms move."""
    rotations = torch.from_numpy(turn.rotations_wxyz[:, 1:]).double()
    angles = 2.0 * torch.arccos(rotations[..., 0].abs().clamp(max=1.0))
    assert angles.max() < np.radians(9.0)
    assert angles[:, bare.joint("LeftArm") - 1].max() > np.radians(1.5)
    jerk = np.abs(np.diff(turn.rotations_wxyz[:, 1:], axis=0)).max()
    assert jerk < 0.02


@pytest.mark.parametrize("turns", [2, 3])
def test_several_turns_in_postures_that_differ(bare: Body, turns: int) -> None:
    """Arms rise and fall by more than ten degrees, also from one turn to the next, without jumps."""
    motion = turn_in_a_pose(bare, 48 * turns, 24.0, GROUND_M, seed=0, turns=turns)
    angles = np.unwrap(headings(motion))
    assert angles[-1] - angles[0] == pytest.approx(2 * np.pi * turns, abs=0.3)
    rotations = torch.from_numpy(motion.rotations_wxyz).double()
    angle = 2.0 * torch.arccos(rotations[..., 0].abs().clamp(max=1.0))
    assert angle[:, 1:].max() < np.radians(25.0)
    for name in ("LeftArm", "RightArm", "Head"):
        joint = bare.joint(name)
        assert angle[:, joint].max() > np.radians(9.0)
        first, second = rotations[:48, joint], rotations[48:96, joint]
        between = 2.0 * torch.arccos((first * second).sum(1).abs().clamp(max=1.0))
        assert between.max() > np.radians(6.0)
    assert np.abs(np.diff(motion.rotations_wxyz[:, 1:], axis=0)).max() < 0.03
    assert np.allclose(lowest_foot_offset_m(bare, motion), GROUND_M[1], atol=1e-5)


def test_one_turn_is_the_default(bare: Body, turn: Motion) -> None:
    one = turn_in_a_pose(bare, 48, 24.0, GROUND_M, seed=0, turns=1)
    assert np.array_equal(one.rotations_wxyz, turn.rotations_wxyz)


def test_sway_depends_on_the_seed(bare: Body, turn: Motion) -> None:
    again = turn_in_a_pose(bare, 48, 24.0, GROUND_M, seed=0)
    other = turn_in_a_pose(bare, 48, 24.0, GROUND_M, seed=1)
    assert np.array_equal(again.rotations_wxyz, turn.rotations_wxyz)
    assert not np.allclose(other.rotations_wxyz, turn.rotations_wxyz)


def test_novel_poses_differ_from_the_turn(bare: Body, turn: Motion) -> None:
    novel = novel_motion(bare, GROUND_M, 5)
    assert len(novel.frame_index) == 5
    for pose in novel.rotations_wxyz[:4, 1:]:
        alike = np.abs((pose * turn.rotations_wxyz[:, 1:]).sum(-1)).min(axis=1)
        assert alike.max() < np.cos(np.radians(30.0) / 2)
    assert np.allclose(lowest_foot_offset_m(bare, novel), GROUND_M[1], atol=1e-5)


def test_arms_up_are_up(bare: Body) -> None:
    index = list(NOVEL_POSES).index("arms_up")
    transforms = canonical_to_world(bare, novel_motion(bare, GROUND_M, 4))[index]
    hand, head = bare.joint("LeftHand"), bare.joint("Head")
    height = [transforms[j, 1, :3] @ torch.from_numpy(bare.joints_m[j]) + transforms[j, 1, 3] for j in (hand, head)]
    assert height[0] > height[1]


def test_snap_feet_to_floor_removes_an_offset(bare: Body, turn: Motion) -> None:
    lifted = turn.with_pose(turn.rotations_wxyz, turn.root_translation_m + [0.0, 0.7, 0.0])
    back = snap_feet_to_floor(bare, lifted, float(GROUND_M[1]))
    assert np.allclose(back.root_translation_m, turn.root_translation_m, atol=1e-5)


def test_partial_turn_goes_to_both_sides_and_back(bare: Body) -> None:
    motion = turn_in_a_pose(bare, 48, 24.0, GROUND_M, seed=0, arc_deg=90.0)
    w, _, y, _ = motion.rotations_wxyz[:, 0].T
    heading_deg = np.degrees(2 * np.arctan2(y, w))
    assert heading_deg.max() == pytest.approx(45, abs=1)
    assert heading_deg.min() == pytest.approx(-45, abs=1)
    assert heading_deg[0] == pytest.approx(0, abs=1)
    assert np.abs(np.diff(heading_deg)).max() < 8


def joints_m(body: Body, motion: Motion, names: list[str]) -> np.ndarray:
    """World positions (n, k, 3)."""
    joints = [body.joint(name) for name in names]
    transforms = canonical_to_world(body, motion)[:, joints].numpy()
    return np.einsum("njab,jb->nja", transforms[..., :3, :3], body.joints_m[joints]) + transforms[..., :3, 3]


def test_bend_turns_the_trunk_forward_and_keeps_the_legs(bare: Body, turn: Motion) -> None:
    """In every frame the trunk turns by the angle about the axis through the hip joints; hips, knees and feet stay."""
    legs = [side + part for side in ("Left", "Right") for part in ("UpLeg", "Leg", "Foot", "ToeBase")]
    bent = bend_at_hips(bare, turn, 5.0)
    before, after = joints_m(bare, turn, legs), joints_m(bare, bent, legs)
    assert np.allclose(before, after, atol=2e-3)
    ends = ["LeftUpLeg", "RightUpLeg", "Neck"]
    upright, leaning = (joints_m(bare, motion, ends) for motion in (turn, bent))
    across = upright[:, 0] - upright[:, 1]
    axes = [trunk[:, 2] - trunk[:, :2].mean(1) for trunk in (upright, leaning)]
    sagittal = [
        axis - across * (axis * across).sum(1, keepdims=True) / (across**2).sum(1, keepdims=True) for axis in axes
    ]
    lengths = np.linalg.norm(sagittal[0], axis=1) * np.linalg.norm(sagittal[1], axis=1)
    cosine = (sagittal[0] * sagittal[1]).sum(1) / lengths
    assert np.degrees(np.arccos(cosine)) == pytest.approx(5.0, abs=0.1)
    front = quaternion_to_matrix(torch.from_numpy(turn.rotations_wxyz[:, 0]))[:, :, 2].numpy()
    assert ((axes[1] - axes[0]) * front).sum(1).min() > 0


def bone_direction(body: Body, motion: Motion, start: str, end: str) -> np.ndarray:
    """Unit vectors from one joint to another in the frame of the hips, (n, 3)."""
    transforms = canonical_to_world(body, motion)
    bone = torch.from_numpy(body.joints_m[body.joint(end)] - body.joints_m[body.joint(start)])
    world = transforms[:, body.joint(start), :3, :3] @ bone
    local = torch.linalg.solve(transforms[:, 0, :3, :3], world[..., None])[..., 0].numpy()
    return local / np.linalg.norm(local, axis=1, keepdims=True)


def test_arms_are_lowered_and_legs_closed_by_their_angles(bare: Body, turn: Motion) -> None:
    changed = add_joint_angles(bare, turn, posture(30.0, 5.0, hand_on_hip=False))
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        for start, end, angle_deg in (("Arm", "ForeArm", 30.0), ("UpLeg", "Leg", 5.0)):
            before, after = (bone_direction(bare, motion, side + start, side + end) for motion in (turn, changed))
            slopes = [np.degrees(np.arctan2(-bone[:, 1], sign * bone[:, 0])) for bone in (before, after)]
            assert np.allclose(slopes[1] - slopes[0], angle_deg, atol=3.0)
    assert np.array_equal(changed.root_translation_m, turn.root_translation_m)


def test_the_hand_is_on_the_hip(bare: Body, turn: Motion) -> None:
    changed = add_joint_angles(bare, turn, posture(0.0, 0.0, hand_on_hip=True))
    joints = torch.from_numpy(bare.joints_m)

    def distance_m(motion: Motion, side: str) -> float:
        transforms = canonical_to_world(bare, motion)
        hand, hip = (bare.joint(side + name) for name in ("Hand", "UpLeg"))
        hand_m, hip_m = (
            transforms[0, joint, :3, :3] @ joints[joint] + transforms[0, joint, :3, 3] for joint in (hand, hip)
        )
        return float((hand_m - hip_m).norm())

    assert distance_m(changed, "Left") < min(0.36, distance_m(turn, "Left") - 0.05)
    assert distance_m(changed, "Right") == pytest.approx(distance_m(turn, "Right"))


def test_no_angles_are_no_change(bare: Body, turn: Motion) -> None:
    same = add_joint_angles(bare, turn, posture(0.0, 0.0, hand_on_hip=False))
    assert np.allclose(same.rotations_wxyz, turn.rotations_wxyz, atol=1e-6)
