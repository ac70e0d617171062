"""Axes and rest poses of the rigs, played back by an independent implementation of glTF."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from pipeline.avatar.gltf import SkinnedMesh, encode_glb
from pipeline.avatar.motion.feet import joint_positions_m
from pipeline.avatar.rig import Rig, build_rig
from pipeline.avatar.rig_names import match_names, rig_joint_name
from pipeline.body.body import Body, Motion, canonical_to_world
from pipeline.geometry.rotation import axis_angle_to_quaternion
from pipeline.geometry.skinning import local_quaternions, top_k_weights
from tests.avatar.avatar_sample import sample_maps
from tests.avatar.test_gltf import Player
from tests.tools.khronos import validator_issues

RIGS = ("plain", "mixamo", "unity", "unreal", "vrm")
LEFT, UP, FRONT = np.eye(3)


def play(rig: Rig, local: dict[str, np.ndarray]) -> tuple[Motion, np.ndarray]:
    """Play local rotations by joint name, as a clip does; other joints keep the rest pose. Return also positions."""
    rest = rig.local_rest_matrices()[:, :3, :3]
    world = np.zeros((len(rest), 3, 3))
    for joint, (name, parent) in enumerate(zip(rig.joint_names, rig.body.parents, strict=True)):
        world[joint] = (world[parent] if parent >= 0 else np.eye(3)) @ local.get(name, rest[joint])
    rotations = local_quaternions((world @ rig.axes.transpose(0, 2, 1))[None], rig.body.parents)
    motion = Motion(np.zeros(1, np.int32), np.zeros(1), rotations, rig.body.joints_m[:1])
    return motion, joint_positions_m(rig.body, motion)[0]


def direction(body: Body, positions: np.ndarray, start: str, end: str) -> np.ndarray:
    bone = positions[body.joint(end)] - positions[body.joint(start)]
    return bone / np.linalg.norm(bone)


def euler(x: float, y: float, z: float) -> np.ndarray:
    return Rotation.from_euler("XYZ", [x, y, z]).as_matrix()


def skinned(body: Body, rig: Rig) -> SkinnedMesh:
    """The body's mesh in the rest pose, with four influences a vertex."""
    indices, weights = top_k_weights(body.skin_weights)
    positions = rig.rest_positions(body.vertices, indices, weights)
    uv = np.zeros((len(positions), 2), np.float32)
    return SkinnedMesh(positions, np.tile(UP, (len(positions), 1)), uv, indices, weights, body.faces)


def bent(body: Body, frames: int = 3) -> Motion:
    """A pose in which every joint is turned."""
    angles = np.random.default_rng(0).uniform(-0.4, 0.4, (frames, len(body.joint_names), 3))
    rotations = axis_angle_to_quaternion(torch.from_numpy(angles)).numpy().astype(np.float32)
    root_m = np.random.default_rng(1).uniform(-1, 1, (frames, 3)).astype(np.float32)
    return Motion(np.arange(frames, dtype=np.int32), np.arange(frames) / 10.0, rotations, root_m)


@pytest.mark.parametrize("rest_pose", ["a", "t"])
@pytest.mark.parametrize("name", RIGS)
def test_a_clip_moves_every_rig_and_rest_pose_alike(name: str, rest_pose: str, bare: Body, tmp_path: Path) -> None:
    """Joints of the played file are where forward kinematics of the A-pose puts them."""
    rig, motion = build_rig(bare, name, rest_pose), bent(bare)
    (tmp_path / "a.glb").write_bytes(encode_glb(skinned(bare, rig), rig, {"bent": motion}, sample_maps()))
    player = Player(tmp_path / "a.glb")
    nodes = player.json["skins"][0]["joints"][: len(bare.joint_names)]
    expected = joint_positions_m(bare, motion)[1]
    played = np.stack([player.global_matrix(node, motion.time_s[1])[:3, 3] for node in nodes])
    np.testing.assert_allclose(played, expected, atol=2e-5)
    assert validator_issues(tmp_path / "a.glb") == []


@pytest.mark.parametrize("rest_pose", ["a", "t"])
def test_the_a_pose_of_every_rest_pose_is_the_mesh_of_the_a_pose(rest_pose: str, bare: Body, tmp_path: Path) -> None:
    rig = build_rig(bare, "mixamo", rest_pose)
    identity = np.tile(np.array([1, 0, 0, 0], np.float32), (2, len(bare.joint_names), 1))
    motion = Motion(np.arange(2, dtype=np.int32), np.arange(2.0), identity, bare.joints_m[[0, 0]])
    (tmp_path / "a.glb").write_bytes(encode_glb(skinned(bare, rig), rig, {"a": motion}, sample_maps()))
    np.testing.assert_allclose(Player(tmp_path / "a.glb").posed_vertices(0.0), bare.vertices, atol=5e-6)


def test_the_rest_pose_is_the_bind_pose_and_a_t_pose(bare: Body, tmp_path: Path) -> None:
    rig = build_rig(bare, "mixamo", "t")
    mesh = skinned(bare, rig)
    (tmp_path / "t.glb").write_bytes(encode_glb(mesh, rig, {"bent": bent(bare)}, sample_maps()))
    player = Player(tmp_path / "t.glb")
    player.json["animations"] = [{"channels": []}]
    np.testing.assert_allclose(player.posed_vertices(0.0), mesh.positions_m, atol=5e-6)
    joints = rig.rest_matrices()[:, :3, 3]
    for side, outward in (("Left", LEFT), ("Right", -LEFT)):
        for start, end in (("Arm", "ForeArm"), ("ForeArm", "Hand"), ("Hand", "HandMiddle1")):
            assert direction(bare, joints, side + start, side + end) @ outward == pytest.approx(1, abs=1e-4)
        assert direction(bare, joints, f"{side}Leg", f"{side}Foot") @ UP == pytest.approx(-1, abs=1e-4)
        across = direction(bare, joints, f"{side}HandPinky1", f"{side}HandIndex1")
        assert across @ FRONT > 0.95  # palms face the floor


def test_the_t_pose_has_no_torn_surface(bare: Body) -> None:
    """Edges keep their length within a factor, also in the armpits."""
    rig = build_rig(bare, "plain", "t")
    moved = skinned(bare, rig).positions_m
    edges = np.unique(np.sort(bare.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    before, after = (np.linalg.norm(v[edges[:, 0]] - v[edges[:, 1]], axis=1) for v in (bare.vertices, moved))
    ratio = after[before > 0.004] / before[before > 0.004]
    assert np.percentile(ratio, 99.9) < 2.5
    assert np.percentile(ratio, 0.1) > 0.4


def test_rotations_of_a_ready_player_me_pose_give_that_pose(bare: Body) -> None:
    """Local rotations of a standing pose of a Ready Player Me avatar (Euler angles in the order x, y, z, rounded).

    Arms hang with the palms towards the thighs, and the elbow bends the forearm to the front.
    """
    rig = build_rig(bare, "plain")
    turned = {
        "LeftShoulder": euler(1.62, -0.17, -1.6),
        "LeftArm": euler(1.28, 0.54, -0.09),
        "LeftForeArm": euler(0.0, 0.0, 0.3),
        "RightShoulder": euler(1.62, 0.06, 1.53),
        "RightArm": euler(1.31, -0.42, 0.13),
        "RightForeArm": euler(0.0, 0.0, -0.32),
        "LeftUpLeg": euler(-0.08, -0.06, 3.13),
        "LeftLeg": euler(-0.25, 0.0, -0.02),
        "LeftFoot": euler(1.32, -0.06, 0.0),
        "LeftToeBase": euler(0.58, -0.07, -0.01),
    }
    motion, joints = play(rig, turned)
    for side, outward in (("Left", LEFT), ("Right", -LEFT)):
        assert direction(bare, joints, f"{side}Arm", f"{side}ForeArm") @ UP < -0.9
        forearm = direction(bare, joints, f"{side}ForeArm", f"{side}Hand")
        assert forearm @ UP < -0.85
        assert forearm @ FRONT > direction(bare, joints, f"{side}Arm", f"{side}ForeArm") @ FRONT + 0.2
        thumb = direction(bare, joints, f"{side}Hand", f"{side}HandThumb1")
        assert thumb @ FRONT > 0.3
        assert direction(bare, joints, f"{side}HandThumb1", f"{side}HandIndex1") @ outward > -0.5
    shin = direction(bare, joints, "LeftLeg", "LeftFoot")
    assert shin @ FRONT < direction(bare, joints, "LeftUpLeg", "LeftLeg") @ FRONT - 0.1  # knees bend backwards
    sole_normal = canonical_to_world(bare, motion)[0, bare.joint("LeftFoot"), :3, 1].numpy()
    assert sole_normal @ UP > 0.98


def test_joints_bend_about_the_axes_that_the_programs_use(bare: Body) -> None:
    """Mixamo: fingers and knees about x, elbows about z. Unreal, with y and z swapped: elbows and knees about y."""
    quarter = np.pi / 2
    mixamo, unreal = build_rig(bare, "mixamo", "t"), build_rig(bare, "unreal", "t")
    cases = (
        (mixamo, "mixamorig:LeftHandIndex1", (quarter, 0, 0), ("LeftHandIndex1", "LeftHandIndex2"), -UP),
        (mixamo, "mixamorig:RightHandIndex1", (quarter, 0, 0), ("RightHandIndex1", "RightHandIndex2"), -UP),
        (mixamo, "mixamorig:LeftForeArm", (0, 0, quarter), ("LeftForeArm", "LeftHand"), FRONT),
        (mixamo, "mixamorig:RightForeArm", (0, 0, -quarter), ("RightForeArm", "RightHand"), FRONT),
        (mixamo, "mixamorig:LeftLeg", (-quarter, 0, 0), ("LeftLeg", "LeftFoot"), -FRONT),
        (unreal, "lowerarm_l", (0, -quarter, 0), ("LeftForeArm", "LeftHand"), FRONT),
        (unreal, "lowerarm_r", (0, -quarter, 0), ("RightForeArm", "RightHand"), FRONT),
        (unreal, "calf_l", (0, -quarter, 0), ("LeftLeg", "LeftFoot"), -FRONT),
        (unreal, "calf_r", (0, -quarter, 0), ("RightLeg", "RightFoot"), -FRONT),
    )
    for rig, name, angles, bone, expected in cases:
        rest = rig.local_rest_matrices()[rig.joint_names.index(name), :3, :3]
        _, joints = play(rig, {name: rest @ euler(*angles)})
        assert direction(bare, joints, *bone) @ expected == pytest.approx(1, abs=2e-3), name


def test_rest_rotations_are_those_of_the_programs_in_the_t_pose(bare: Body) -> None:
    """Mixamo: y along the bone. Unreal: x along it, on the right against it. Unity and VRM: the axes of the world."""
    for name in ("unity", "vrm"):
        world = build_rig(bare, name, "t").rest_matrices()[:, :3, :3]
        np.testing.assert_allclose(world, np.tile(np.eye(3), (len(world), 1, 1)), atol=1e-6)
    mixamo = build_rig(bare, "mixamo", "t").rest_matrices()[:, :3, :3]
    np.testing.assert_allclose(mixamo[bare.joint("LeftArm")], np.stack([-FRONT, LEFT, -UP], axis=1), atol=1e-6)
    np.testing.assert_allclose(mixamo[bare.joint("RightArm")], np.stack([FRONT, -LEFT, -UP], axis=1), atol=1e-6)
    np.testing.assert_allclose(mixamo[bare.joint("LeftUpLeg")], np.diag([-1.0, -1.0, 1.0]), atol=1e-6)
    unreal = build_rig(bare, "unreal", "t").rest_matrices()[:, :3, :3]
    np.testing.assert_allclose(unreal[bare.joint("LeftForeArm")], np.stack([LEFT, UP, FRONT], axis=1), atol=1e-6)
    np.testing.assert_allclose(unreal[bare.joint("RightForeArm")], np.stack([LEFT, -UP, -FRONT], axis=1), atol=1e-6)
    np.testing.assert_allclose(unreal[bare.joint("Spine1")], np.stack([UP, -LEFT, FRONT], axis=1), atol=1e-6)
    for rig in RIGS:
        determinants = np.linalg.det(build_rig(bare, rig, "a").axes)
        np.testing.assert_allclose(determinants, 1.0, atol=1e-6)


def test_unreal_has_a_root_without_weights(bare: Body, tmp_path: Path) -> None:
    rig = build_rig(bare, "unreal")
    (tmp_path / "a.glb").write_bytes(encode_glb(skinned(bare, rig), rig, {"bent": bent(bare)}, sample_maps()))
    player = Player(tmp_path / "a.glb")
    skin = player.json["skins"][0]
    root = player.json["nodes"][skin["skeleton"]]
    assert root["name"] == "root"
    assert [player.json["nodes"][child]["name"] for child in root["children"]] == ["pelvis"]
    assert skin["skeleton"] in player.json["scenes"][0]["nodes"]
    attributes = player.json["meshes"][0]["primitives"][0]["attributes"]
    assert player.array(attributes["JOINTS_0"]).max() < len(bare.joint_names)


def test_names_of_joints() -> None:
    names = ("Hips", "LeftHandThumb1", "RightToeBase", "Spine2", "Jaw")
    expected = {
        "plain": names,
        "mixamo": ("mixamorig:Hips", "mixamorig:LeftHandThumb1", "mixamorig:RightToeBase", "mixamorig:Spine2", "Jaw"),
        "unity": ("Hips", "LeftThumbProximal", "RightToes", "UpperChest", "Jaw"),
        "unreal": ("pelvis", "thumb_01_l", "ball_r", "spine_03", "Jaw"),
        "vrm": ("hips", "leftThumbMetacarpal", "rightToes", "upperChest", "Jaw"),
    }
    for rig, wanted in expected.items():
        assert tuple(rig_joint_name(name, rig) for name in names) == wanted


@pytest.mark.parametrize("rig", RIGS)
def test_joints_are_matched_in_every_rig(rig: str, bare: Body) -> None:
    own = tuple(rig_joint_name(name, rig) for name in bare.joint_names)
    spelt = tuple(name.replace(":", "").upper() for name in own)
    robot = tuple(f"Robot-07_{name}" for name in own)
    for names in (own, spelt, ("Armature", *own), robot):
        offset = len(names) - len(own)
        assert match_names(names) == {name: joint + offset for joint, name in enumerate(bare.joint_names)}


def test_a_joint_with_another_name_has_the_axes_of_the_torso(bare: Body) -> None:
    head = bare.joint("Head")
    body = replace(bare, joint_names=(*bare.joint_names[:head], "Jaw", *bare.joint_names[head + 1 :]))
    for rig in ("mixamo", "unreal"):
        axes = build_rig(body, rig).axes
        np.testing.assert_array_equal(axes[head], axes[0])
