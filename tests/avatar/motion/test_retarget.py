"""Retargeting: the identity for the same skeleton; equal limb directions for another one."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from data_tools.synthetic.scene.motion import turn_in_a_pose
from pipeline.avatar.motion.bvh_export import motion_to_bvh
from pipeline.avatar.motion.feet import lowest_foot_offset_m
from pipeline.avatar.motion.planting import plant_feet
from pipeline.avatar.motion.retarget import match_joints, resample_motion, retarget, retarget_with_contacts
from pipeline.avatar.rig import build_rig
from pipeline.body.body import Body, Motion, canonical_to_world
from pipeline.core.errors import UserError
from pipeline.geometry.rotation import axis_angle_to_quaternion, quaternion_to_matrix
from pipeline.io.bvh import BvhMotion, read_bvh, write_bvh
from tests.avatar.motion.test_planting import slides_m

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


def test_hips_that_move_below_a_reference_joint_move_the_avatar(bare: Body, turn: Motion, tmp_path: Path) -> None:
    """MotionBuilder's files: the root stands still beside the scene and is turned, its child has six channels."""
    here = recorded(bare, turn)
    here = replace(here, root_positions=here.root_positions + np.linspace(0, 300, 24)[:, None] * [0, 0, 1])
    corner, tilt = np.array([40.0, -10.0, 70.0]), Rotation.from_euler("X", -60.0, degrees=True).as_matrix()
    rotations = np.concatenate([np.tile(tilt, (24, 1, 1, 1)), here.rotations], axis=1)
    rotations[:, 1] = tilt.T @ here.rotations[:, 0]
    hips = (here.root_positions - corner) @ tilt
    there = BvhMotion(
        ("Reference", *here.joint_names),
        np.array([-1, *(here.parents + 1)]),
        np.concatenate([np.zeros((1, 3)), here.offsets]),
        rotations,
        np.tile(corner, (24, 1)),
        here.fps,
        {1: hips},
    )
    write_bvh(tmp_path / "reference.bvh", there)
    read = read_bvh(tmp_path / "reference.bvh")
    one, other = (retarget(bvh_motion, bare, GROUND_M, in_place=False) for bvh_motion in (here, read))
    assert np.ptp(other.root_translation_m[:, 2]) == pytest.approx(3.0, abs=0.05)
    assert np.allclose(joint_positions(bare, one), joint_positions(bare, other), atol=1e-3)


def fallen(body: Body, lying: float, pitch_deg: float) -> Motion:
    """The A-pose stands, falls in a fifth of the time and lies for a part of it; negative pitch: on the back."""
    frames = 60
    share = np.clip((np.arange(frames) / (frames - 1) - (0.8 - lying)) / 0.2, 0.0, 1.0)
    rotations = np.tile(np.array([1.0, 0.0, 0.0, 0.0], np.float32), (frames, len(body.joint_names), 1))
    half_rad = np.radians(0.5 * pitch_deg) * share
    rotations[:, 0, 0], rotations[:, 0, 1] = np.cos(half_rad), np.sin(half_rad)
    root_m = np.repeat(body.joints_m[:1], frames, axis=0)
    root_m[:, 1] -= 0.7 * share.astype(np.float32)
    return Motion(np.arange(frames, dtype=np.int32), np.arange(frames) / 30.0, rotations, root_m)


@pytest.mark.parametrize("z_is_up", [False, True])
@pytest.mark.parametrize(("lying", "pitch_deg"), [(0.2, -90.0), (0.7, -90.0), (0.7, 90.0)])
def test_a_person_who_lies_most_of_the_time_is_not_turned_upright(
    lying: float, pitch_deg: float, z_is_up: bool, bare: Body
) -> None:
    """Also played backwards, where the first frame has its front up or down, and in a file with all axes turned."""
    motion, name = fallen(bare, lying, pitch_deg), bare.joint("Head")
    clip = recorded(bare, motion, 30.0)
    if z_is_up:
        turn = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
        rotations = turn @ clip.rotations @ turn.T
        clip = replace(
            clip, offsets=clip.offsets @ turn.T, rotations=rotations, root_positions=clip.root_positions @ turn.T
        )
    for rows in (slice(None), slice(None, None, -1)):
        played = replace(clip, rotations=clip.rotations[rows], root_positions=clip.root_positions[rows])
        found = joint_positions(bare, retarget(played, bare, np.zeros(3), in_place=False))
        wanted = joint_positions(bare, motion)[rows]
        trunks = [directions(positions, 0, name) for positions in (found, wanted)]
        assert np.degrees(np.arccos((trunks[0] * trunks[1]).sum(axis=1).clip(-1, 1))).max() < 6.0


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


def t_posed(body: Body) -> Body:
    """The skeleton in its T-pose."""
    matrices = build_rig(body, "vrm", "t").rest_matrices()
    return replace(body, joints_m=matrices[:, :3, 3].astype(np.float32))


def in_another_rig(bvh_motion: BvhMotion, body: Body, seed: int | None) -> BvhMotion:
    """The same recording by a skeleton with a T-pose as rest pose, and in inches; with a seed the axes are random.

    The zero pose of random axes is no pose of a person.
    """
    to_rest = build_rig(body, "vrm", "t").bind_to_rest[:, :3, :3]
    axes = np.tile(np.eye(3), (len(body.joint_names), 1, 1))
    if seed is not None:
        axes = Rotation.random(len(body.joint_names), random_state=seed).as_matrix()
    world, _ = bvh_motion.forward_kinematics(bvh_motion.rotations)
    turned = world @ to_rest.transpose(0, 2, 1) @ axes
    local, parents = turned.copy(), body.parents
    local[:, 1:] = turned[:, parents[1:]].transpose(0, 1, 3, 2) @ turned[:, 1:]
    rest_m = t_posed(body).joints_m.astype(float)
    offsets = rest_m - rest_m[np.maximum(parents, 0)]
    offsets[1:] = np.einsum("jba,jb->ja", axes[parents[1:]], offsets[1:])
    inches = 1.0 / 0.0254
    root = 0.01 * inches * bvh_motion.root_positions
    return BvhMotion(bvh_motion.joint_names, parents.astype(int), inches * offsets, local, root, bvh_motion.fps)


@pytest.mark.parametrize(("seed", "max_twist_deg"), [(None, 3.0), (0, 6.0), (1, 6.0)])
def test_a_clip_of_another_rest_pose_roll_and_scale_gives_the_same_rotations(
    seed: int | None, max_twist_deg: float, bare: Body, turn: Motion
) -> None:
    """Directions of bones are equal; the twist is that of the rest pose, or of a recorded pose, in which arms sway."""
    here = recorded(bare, turn)
    one, other = (retarget(clip, bare, GROUND_M, in_place=False) for clip in (here, in_another_rig(here, bare, seed)))
    for start, end in (*LIMBS, ("LeftHand", "LeftHandMiddle1"), ("RightHandIndex1", "RightHandIndex2")):
        bones = [directions(joint_positions(bare, m), bare.joint(start), bare.joint(end)) for m in (one, other)]
        cosine = (bones[0] * bones[1]).sum(axis=1)
        assert np.degrees(np.arccos(cosine.clip(-1, 1))).max() < 0.3
    limbs = [bare.joint(name) for name in bare.joint_names if name.endswith(("Arm", "Hand", "Leg"))]
    assert world_angles_deg(bare, one, other)[:, limbs].max() < max_twist_deg
    np.testing.assert_allclose(one.root_translation_m, other.root_translation_m, atol=5e-3)


def turned_out_and_bent(body: Body, turn: Motion, turned_out_deg: float) -> Motion:
    """The right leg and the left arm are twisted in all frames, and all knees and elbows bend by 25 to 90 degrees."""
    rotations = turn.rotations_wxyz.copy()
    bend_rad = np.radians(np.linspace(25.0, 90.0, len(rotations)))

    def turned(axis: np.ndarray, angle_rad: np.ndarray) -> np.ndarray:
        unit = axis / np.linalg.norm(axis)
        return Rotation.from_rotvec(angle_rad[:, None] * unit).as_quat()[:, [3, 0, 1, 2]]

    for side in ("Left", "Right"):
        for start, hinge, is_twisted in (("UpLeg", "Leg", side == "Right"), ("Arm", "ForeArm", side == "Left")):
            first, second = body.joint(side + start), body.joint(side + hinge)
            bone = body.joints_m[second] - body.joints_m[first]
            axis = np.array([1.0, 0.0, 0.0]) if hinge == "Leg" else np.cross(bone, [0.0, 0.0, 1.0])
            rotations[:, first] = turned(bone, np.full(len(bend_rad), np.radians(turned_out_deg) * is_twisted))
            rotations[:, second] = turned(axis, bend_rad)
    return turn.with_pose(rotations.astype(np.float32), turn.root_translation_m)


@pytest.mark.parametrize("seed", [0, 1])
def test_limbs_that_no_recorded_pose_shows_as_in_an_a_pose_are_twisted_as_they_bend(
    seed: int, bare: Body, turn: Motion
) -> None:
    """A leg that is turned out all the time, as a dancer's, whose knee else would bend sideways; an arm likewise."""
    motion = turned_out_and_bent(bare, turn, 60.0)
    found = retarget(in_another_rig(recorded(bare, motion), bare, seed), bare, GROUND_M, in_place=False)
    limbs = [bare.joint(name) for name in bare.joint_names if name.endswith(("Arm", "Leg", "LeftHand", "RightFoot"))]
    assert world_angles_deg(bare, motion, found)[:, limbs].max() < 12.0


def test_the_rest_pose_of_a_t_pose_rig_is_not_twisted(bare: Body) -> None:
    """One frame in the T-pose, of a rig whose rest pose is that T-pose: arms as in the avatar's own T-pose."""
    body = t_posed(bare)
    still = np.tile(np.eye(3), (20, len(bare.joint_names), 1, 1))
    offsets = (body.joints_m - body.joints_m[np.maximum(body.parents, 0)]).astype(float)
    root = np.repeat(body.joints_m[:1].astype(float), 20, axis=0)
    clip = BvhMotion(bare.joint_names, body.parents.astype(int), offsets, still, root, 30.0)
    motion = retarget(clip, bare, np.zeros(3), in_place=False)
    wanted = build_rig(bare, "vrm", "t").bind_to_rest[:, :3, :3]
    found = canonical_to_world(bare, motion)[0, :, :3, :3].numpy()
    for name in ("LeftArm", "RightForeArm", "LeftHand", "RightUpLeg", "LeftLeg", "RightHandIndex2"):
        joint = bare.joint(name)
        angle = Rotation.from_matrix(found[joint] @ wanted[joint].T).magnitude()
        assert np.degrees(angle) < 6.0, name  # the axis through hips and head is not quite the vertical


def test_hands_without_fingers_stay_as_in_the_a_pose(bare: Body, turn: Motion) -> None:
    clip = recorded(bare, turn)
    kept = [joint for joint, name in enumerate(bare.joint_names) if "Hand" not in name or name.endswith("Hand")]
    renumbered = {old: new for new, old in enumerate(kept)}
    parents = np.array([renumbered.get(int(parent), -1) for parent in clip.parents[kept]])
    names = tuple(clip.joint_names[joint] for joint in kept)
    short = BvhMotion(names, parents, clip.offsets[kept], clip.rotations[:, kept], clip.root_positions, clip.fps)
    motion = retarget(short, bare, GROUND_M, in_place=False)
    fingers = [joint for joint in range(len(bare.joint_names)) if joint not in kept]
    np.testing.assert_allclose(np.abs(motion.rotations_wxyz[:, fingers, 0]), 1.0, atol=1e-6)


def test_a_longer_person_walks_at_the_speed_of_its_legs(bare: Body, turn: Motion) -> None:
    clip = recorded(bare, turn)
    walking = replace(clip, root_positions=clip.root_positions + np.linspace(0, 300, 24)[:, None] * [0, 0, 1])
    giant = replace(bare, joints_m=1.5 * bare.joints_m, vertices=1.5 * bare.vertices)
    distance = [
        np.ptp(retarget(walking, body, GROUND_M, in_place=False).root_translation_m[:, 2]) for body in (bare, giant)
    ]
    assert distance[1] / distance[0] == pytest.approx(1.5, rel=0.02)


def test_a_motion_written_as_bvh_gives_the_same_motion_again(bare: Body, turn: Motion, tmp_path: Path) -> None:
    """Through the file, in the names of each rig and both rest poses."""
    for rig_name, rest_pose in (("plain", "a"), ("mixamo", "t"), ("unreal", "a")):
        rig = build_rig(bare, rig_name, rest_pose)
        write_bvh(tmp_path / "turn.bvh", motion_to_bvh(rig, turn, 24.0))
        read = read_bvh(tmp_path / "turn.bvh")
        _, positions = read.forward_kinematics(read.rotations)
        names = [read.joint_names.index(name) for name in rig.joint_names]
        joints_m = 0.01 * (positions + read.root_positions[:, None])[:, names]
        np.testing.assert_allclose(joints_m, joint_positions(bare, turn), atol=2e-5)
        again = retarget(read, bare, GROUND_M, in_place=False)
        limbs = [bare.joint(name) for name in bare.joint_names if name.endswith(("Arm", "Leg"))]
        relative = world_angles_deg(bare, again, retarget(recorded(bare, turn), bare, GROUND_M, in_place=False))
        assert relative[:, limbs].max() < 6.0


def world_angles_deg(body: Body, one: Motion, other: Motion) -> np.ndarray:
    """Angle between the world rotations of each joint in each frame."""
    first, second = (canonical_to_world(body, motion)[..., :3, :3].numpy() for motion in (one, other))
    relative = (first.transpose(0, 1, 3, 2) @ second).reshape(-1, 3, 3)
    return np.degrees(Rotation.from_matrix(relative).magnitude()).reshape(first.shape[:2])


@pytest.mark.parametrize("name", ["cmu1_jumping_jacks", "fair1_zombie", "rokoko_jesse_dance"])
def test_planted_clips_do_not_slide_and_keep_the_arms(name: str, bare: Body, shared_data: Path) -> None:
    clip = read_bvh(shared_data / "motions" / f"{name}.bvh")
    motion, contact = retarget_with_contacts(clip, bare, np.zeros(3), in_place=False)
    planted = plant_feet(bare, motion, contact, 0.0)
    assert contact.any()
    assert max(slides_m(bare, planted, contact)) < 0.005
    assert lowest_foot_offset_m(bare, planted).min() > -0.002
    turned_deg = world_angles_deg(bare, motion, planted)
    others = [k for k, name in enumerate(bare.joint_names) if not name.endswith("Leg") and name != "Hips"]
    assert turned_deg[:, others].max() < 0.1
    assert turned_deg[:, 0].max() < 6.0
    assert np.median(turned_deg) < 0.1


def test_standing_feet_are_flat_whatever_they_are_in_the_reference_pose(bare: Body) -> None:
    """Only the first frame is an A-pose, and in it the feet point down; then arms are raised and feet stand."""
    frames = 40
    angles = np.zeros((frames, len(bare.joint_names), 3))
    angles[0, [bare.joint("LeftFoot"), bare.joint("RightFoot")], 0] = 0.5
    angles[1:, bare.joint("LeftArm"), 2], angles[1:, bare.joint("RightArm"), 2] = 1.2, -1.2
    rotations = axis_angle_to_quaternion(torch.from_numpy(angles)).numpy().astype(np.float32)
    root_m = np.repeat(bare.joints_m[:1], frames, axis=0)
    still = Motion(np.arange(frames, dtype=np.int32), np.arange(frames) / 30.0, rotations, root_m)
    motion = retarget(in_another_rig(recorded(bare, still, 30.0), bare, seed=2), bare, np.zeros(3), in_place=False)
    soles = canonical_to_world(bare, motion)[1:, [bare.joint("LeftFoot"), bare.joint("RightToeBase")], :3, 1]
    assert soles[..., 1].min() > np.cos(np.radians(1.5))
