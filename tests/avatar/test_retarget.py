"""Retargeting: the identity for the same skeleton; equal limb directions for another one."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from data_tools.synthetic.scene.motion import turn_in_a_pose
from pipeline.avatar.feet import lowest_foot_offset_m
from pipeline.avatar.retarget import match_joints, resample_motion, retarget
from pipeline.body.body import Body, Motion, canonical_to_world
from pipeline.core.errors import UserError
from pipeline.geometry.rotation import quaternion_to_matrix
from pipeline.io.bvh import BvhMotion, read_bvh

GROUND_M = np.array([0.0, -0.9, -3.5])
LIMBS = (("LeftArm", "LeftForeArm"), ("RightForeArm", "RightHand"), ("LeftUpLeg", "LeftLeg"), ("RightLeg", "RightFoot"))


def recorded(body: Body, motion: Motion, fps: float = 24.0) -> BvhMotion:
    """A motion of the generated body as a BVH motion, in centimetres."""
    offsets = 100.0 * (body.joints_m - body.joints_m[np.maximum(body.parents, 0)]).astype(float)
    rotations = quaternion_to_matrix(torch.from_numpy(motion.rotations_wxyz).double()).numpy()
    positions = 100.0 * motion.root_translation_m.astype(float)
    return BvhMotion(body.joint_names, body.parents.astype(int), offsets, rotations, positions, fps)


def joint_positions(body: Body, motion: Motion) -> np.ndarray:
    transforms = canonical_to_world(body, motion)
    joints = (transforms[..., :3, :3] @ torch.from_numpy(body.joints_m)[:, :, None]).squeeze(-1)
    return (joints + transforms[..., :3, 3]).numpy()


def directions(positions: np.ndarray, start: int, end: int) -> np.ndarray:
    bone = positions[:, end] - positions[:, start]
    return bone / np.linalg.norm(bone, axis=1, keepdims=True)


@pytest.fixture(scope="module")
def turn(bare: Body) -> Motion:
    return turn_in_a_pose(bare, 24, 24.0, GROUND_M, seed=3)


def test_retargeting_to_the_same_body_is_the_identity(bare: Body, turn: Motion) -> None:
    """Up to the heading, which is that of the first frame, and the measured front of the torso."""
    back = retarget(recorded(bare, turn), bare, GROUND_M, in_place=False)
    before, after = joint_positions(bare, turn), joint_positions(bare, back)
    for start, end in LIMBS:
        joints = bare.joint(start), bare.joint(end)
        cosine = (directions(before, *joints) * directions(after, *joints)).sum(axis=1)
        assert np.degrees(np.arccos(cosine.clip(-1, 1))).max() < 4.0
    assert np.abs(before - after).max() < 0.05


def test_result_is_independent_of_the_axes_of_the_file(bare: Body, turn: Motion) -> None:
    """The same recording with Z up and another heading gives the same motion."""
    here = recorded(bare, turn)
    z_up = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    rotations = here.rotations.copy()
    rotations[:, 0] = z_up @ rotations[:, 0]
    there = replace(here, rotations=rotations, root_positions=here.root_positions @ z_up.T)
    one, other = (retarget(bvh_motion, bare, GROUND_M, in_place=False) for bvh_motion in (here, there))
    assert np.allclose(joint_positions(bare, one), joint_positions(bare, other), atol=1e-3)


def test_alternative_joint_names(bare: Body, turn: Motion) -> None:
    """LeftShoulder is the upper arm in CMU files and the collar bone in Mixamo files."""
    table = {"Arm": "Shoulder", "ForeArm": "Elbow", "Hand": "Wrist", "Shoulder": "Collar"}
    table |= {"UpLeg": "Hip", "Leg": "Knee", "Foot": "Ankle", "ToeBase": "Toe"}
    names = {f"{s}{ours}": f"{s}{theirs}" for s in ("Left", "Right") for ours, theirs in table.items()}
    bvh_motion = recorded(bare, turn)
    cmu = replace(bvh_motion, joint_names=tuple(names.get(name, name) for name in bare.joint_names))
    recorded_joint_of = match_joints(cmu, bare)
    assert recorded_joint_of["LeftArm"] == bare.joint("LeftArm")
    assert recorded_joint_of["LeftShoulder"] == bare.joint("LeftShoulder")
    assert recorded_joint_of["RightFoot"] == bare.joint("RightFoot")


def test_missing_joint_is_an_error(bare: Body, turn: Motion) -> None:
    names = tuple(name.replace("LeftForeArm", "Tail") for name in bare.joint_names)
    with pytest.raises(UserError, match="no joint for LeftForeArm"):
        match_joints(replace(recorded(bare, turn), joint_names=names), bare)


def test_in_place_removes_horizontal_translation(bare: Body, turn: Motion) -> None:
    bvh_motion = recorded(bare, turn)
    walking = replace(
        bvh_motion, root_positions=bvh_motion.root_positions + np.linspace(0, 300, 24)[:, None] * [0, 0, 1]
    )
    root = retarget(walking, bare, GROUND_M, in_place=True).root_translation_m
    assert np.allclose(root[:, [0, 2]], GROUND_M[[0, 2]], atol=1e-5)
    free = retarget(walking, bare, GROUND_M, in_place=False).root_translation_m
    assert np.ptp(free[:, 2]) == pytest.approx(3.0, abs=0.05)


def test_resampling_takes_the_nearest_pose(turn: Motion) -> None:
    half = resample_motion(turn, 0.25, 8, 12.0)
    assert np.array_equal(half.rotations_wxyz, turn.rotations_wxyz[6:22:2])
    assert half.frame_index.tolist() == list(range(8))
    assert np.allclose(half.time_s, np.arange(8) / 12.0)
    with pytest.raises(UserError, match="the motion ends at"):
        resample_motion(turn, 0.25, 20, 12.0)


@pytest.mark.parametrize("name", ["cmu1_jumping_jacks", "fair1_zombie", "rokoko_jesse_dance"])
def test_limb_directions_match_the_recording(name: str, bare: Body, shared_data: Path) -> None:
    """Angles between limbs are invariant to the axes: file and result agree to 0.1 degrees."""
    bvh_motion = read_bvh(shared_data / "motions" / f"{name}.bvh")
    motion = retarget(bvh_motion, bare, GROUND_M, in_place=False)
    recorded_joint_of = match_joints(bvh_motion, bare)
    _, theirs = bvh_motion.forward_kinematics(bvh_motion.rotations)
    ours = joint_positions(bare, motion)
    for (a, b), (c, d) in zip(LIMBS, LIMBS[1:] + LIMBS[:1], strict=True):
        cosines = [
            (directions(p, at(a), at(b)) * directions(p, at(c), at(d))).sum(axis=1)
            for p, at in ((ours, bare.joint), (theirs, recorded_joint_of.__getitem__))
        ]
        assert np.allclose(*cosines, atol=2e-3)
    assert lowest_foot_offset_m(bare, motion).min() > GROUND_M[1] - 1e-4
    assert np.percentile(lowest_foot_offset_m(bare, motion), 30) == pytest.approx(GROUND_M[1], abs=1e-3)
    first_front = quaternion_to_matrix(torch.from_numpy(motion.rotations_wxyz[:1, 0]))[0, :, 2]
    assert first_front[2] > 0.6
