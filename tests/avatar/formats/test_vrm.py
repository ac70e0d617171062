"""VRM files, read back and posed by an independent player of glTF."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.avatar.formats.vrm import VrmMeta, encode_vrm0, encode_vrm1
from pipeline.avatar.vrm_bones import human_bones
from pipeline.io.glb import GlbFile
from pipeline.io.glb_writer import GlbWriter
from tests.avatar.formats.anny_avatar import anny_body, anny_glb
from tests.avatar.formats.column import add_root_joint
from tests.avatar.test_gltf import Player
from tests.tools.khronos import validator_issues

META = VrmMeta("avatar", "A. Person", "")
JOINT_OF_BONE = {
    "hips": "Hips",
    "spine": "Spine",
    "chest": "Spine1",
    "upperChest": "Spine2",
    "neck": "Neck",
    "head": "Head",
    "leftShoulder": "LeftShoulder",
    "leftUpperArm": "LeftArm",
    "leftLowerArm": "LeftForeArm",
    "leftHand": "LeftHand",
    "rightUpperLeg": "RightUpLeg",
    "rightLowerLeg": "RightLeg",
    "rightFoot": "RightFoot",
    "rightToes": "RightToeBase",
    "leftLittleProximal": "LeftHandPinky1",
    "rightIndexIntermediate": "RightHandIndex2",
    "rightRingDistal": "RightHandRing3",
    "leftThumbProximal": "LeftHandThumb2",
    "leftThumbDistal": "LeftHandThumb3",
}
TURNED = np.array([-1.0, 1.0, -1.0])


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, GlbFile]:
    folder = tmp_path_factory.mktemp("vrm")
    glb = anny_glb(folder)
    names = anny_body().joint_names
    (folder / "one.vrm").write_bytes(encode_vrm1(glb, names, META))
    (folder / "zero.vrm").write_bytes(encode_vrm0(glb, names, META))
    return {"glb": glb, "1.0": GlbFile(folder / "one.vrm"), "0.x": GlbFile(folder / "zero.vrm")}


def extension(file: GlbFile) -> dict[str, Any]:
    (found,) = file.gltf["extensions"].values()
    return found


def bone_nodes(file: GlbFile) -> dict[str, str]:
    """Name of the node of each human bone."""
    bones = extension(file)["humanoid"]["humanBones"]
    nodes = (
        {entry["bone"]: entry["node"] for entry in bones}
        if isinstance(bones, list)
        else {bone: entry["node"] for bone, entry in bones.items()}
    )
    return {bone: file.gltf["nodes"][node]["name"] for bone, node in nodes.items()}


class RestPlayer(Player):
    """Plays a file without clips: all joints in the pose of their nodes, some turned."""

    def __init__(self, path: Path, turned: dict[str, np.ndarray] | None = None) -> None:
        super().__init__(path)
        self.json["animations"] = [{"channels": []}]
        self.turned = turned or {}

    def local_matrix(self, node: int, time_s: float) -> np.ndarray:
        matrix = super().local_matrix(node, time_s)
        matrix[:3, :3] = matrix[:3, :3] @ self.turned.get(self.json["nodes"][node]["name"], np.eye(3))
        return matrix

    def joint_m(self, name: str) -> np.ndarray:
        node = next(index for index, node in enumerate(self.json["nodes"]) if node["name"] == name)
        return self.global_matrix(node, 0.0)[:3, 3]


def test_human_bones_are_the_right_joints(files: dict[str, GlbFile]) -> None:
    found = bone_nodes(files["1.0"])
    assert JOINT_OF_BONE.items() <= found.items()
    assert len(found) == len(set(found.values())) == len(anny_body().joint_names)


def test_version_0_counts_the_bones_of_the_thumb_otherwise(files: dict[str, GlbFile]) -> None:
    found = bone_nodes(files["0.x"])
    thumb = {"leftThumbProximal": "LeftHandThumb1", "leftThumbIntermediate": "LeftHandThumb2"}
    assert {**JOINT_OF_BONE, **thumb}.items() <= found.items()
    assert "leftThumbMetacarpal" not in found


def test_the_rest_pose_is_a_t_pose_on_the_floor(files: dict[str, GlbFile]) -> None:
    player = RestPlayer(files["1.0"].path)
    wrist, shoulder = player.joint_m("LeftHand"), player.joint_m("LeftArm")
    np.testing.assert_allclose((wrist - shoulder)[1:], 0.0, atol=1e-6)
    assert wrist[0] > shoulder[0] > 0.0
    assert abs(player.posed_vertices(0.0)[:, 1].min()) < 1e-6
    assert player.joint_m("LeftToeBase")[2] > player.joint_m("LeftFoot")[2]  # faces +Z


def test_version_0_is_the_t_pose_turned_by_180_degrees(files: dict[str, GlbFile]) -> None:
    one, zero = RestPlayer(files["1.0"].path), RestPlayer(files["0.x"].path)
    for name in ("Hips", "Head", "LeftHandIndex3", "RightToeBase"):
        np.testing.assert_allclose(zero.joint_m(name), TURNED * one.joint_m(name), atol=1e-6)
    stored = files["0.x"].accessor(files["0.x"].gltf["meshes"][0]["primitives"][0]["attributes"]["POSITION"])
    np.testing.assert_allclose(zero.posed_vertices(0.0), stored, atol=1e-5)  # the mesh itself is in the T-pose
    # blended vertices differ: the one is the skinned A-pose, the other returns to the A-pose exactly
    difference_m = np.linalg.norm(stored - TURNED * one.posed_vertices(0.0), axis=1)
    assert np.median(difference_m) < 1e-3
    assert np.percentile(difference_m, 99) < 0.03


@pytest.mark.parametrize(("version", "turn"), [("1.0", 1.0), ("0.x", TURNED)])
def test_turning_the_joints_back_gives_the_avatar(files: dict[str, GlbFile], version: str, turn: Any) -> None:
    """Rotations that take the T-pose's joints to those of the A-pose take the mesh to the A-pose, to 0.02 mm."""
    player = RestPlayer(files[version].path)
    skin = player.json["skins"][0]
    rest = np.stack([player.global_matrix(node, 0.0) for node in skin["joints"]])
    stored = files["glb"].accessor(files["glb"].gltf["meshes"][0]["primitives"][0]["attributes"]["POSITION"])
    a_pose = _align(rest[:, :3, 3], turn * anny_body().joints_m, anny_body().parents, anny_body().joint_names)
    names = [player.json["nodes"][node]["name"] for node in skin["joints"]]
    player.turned = dict(zip(names, a_pose, strict=True))
    posed = player.posed_vertices(0.0)
    on_torso = _weight_of(files["glb"], ("Hips", "Spine", "Spine1", "Spine2", "LeftArm", "LeftForeArm")) > 0.99999
    offset = (turn * stored - posed)[on_torso]
    assert on_torso.sum() > 500
    np.testing.assert_allclose(offset - offset.mean(axis=0), 0.0, atol=2e-5)


def _weight_of(file: GlbFile, names: tuple[str, ...]) -> np.ndarray:
    primitive = file.skinned_primitives()[0]
    joints = [anny_body().joint(name) for name in names]
    return np.where(np.isin(primitive.joints, joints), primitive.weights, 0.0).sum(axis=1)


def _align(rest_m: np.ndarray, target_m: np.ndarray, parents: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """Local rotations of left upper arm and forearm that point them from rest to target along the smallest arcs."""
    from scipy.spatial.transform import Rotation

    local = np.tile(np.eye(3), (len(names), 1, 1))
    parent = np.eye(3)
    for name, child in (("LeftArm", "LeftForeArm"), ("LeftForeArm", "LeftHand")):
        start, end = names.index(name), names.index(child)
        bone, goal = parent @ (rest_m[end] - rest_m[start]), target_m[end] - target_m[start]
        axis = np.cross(bone, goal)
        angle = np.arctan2(np.linalg.norm(axis), bone @ goal)
        world = Rotation.from_rotvec(axis / np.linalg.norm(axis) * angle).as_matrix() @ parent
        local[start] = parent.T @ world
        parent = world
    return local


@pytest.mark.parametrize("version", ["1.0", "0.x"])
def test_joints_have_no_rotation_and_there_is_no_clip_or_camera(files: dict[str, GlbFile], version: str) -> None:
    document = files[version].gltf
    assert not {"animations", "cameras", "extensionsRequired"} & set(document)
    assert all(set(node) <= {"name", "children", "translation", "mesh", "skin"} for node in document["nodes"])
    assert len(document["nodes"]) == 1 + len(anny_body().joint_names)


@pytest.mark.parametrize("rig", ["plain", "unreal"])
def test_eyes_keep_their_place_in_the_head(tmp_path: Path, rig: Any) -> None:
    """In both versions, and where the head of the .glb has other axes than the world, as in Unreal's rig."""
    head_m = anny_body().joints_m[anny_body().joint("Head")]
    eyes_m = np.array([[0.03, 0.12, 0.1], [-0.03, 0.12, 0.1]]) + head_m
    glb, head = anny_glb(tmp_path, None, rig, eyes_m), "head" if rig == "unreal" else "Head"
    for turn, encode in ((1.0, encode_vrm1), (TURNED, encode_vrm0)):
        (tmp_path / "eyes.vrm").write_bytes(encode(glb, anny_body().joint_names, META))
        player = RestPlayer(tmp_path / "eyes.vrm")
        found = [player.joint_m(name) - player.joint_m(head) for name in ("LeftEye", "RightEye")]
        np.testing.assert_allclose(found, turn * (eyes_m - head_m), atol=1e-6)


def test_the_licence_grants_no_more_than_its_author_says(files: dict[str, GlbFile]) -> None:
    one, zero = (extension(files[version])["meta"] for version in ("1.0", "0.x"))
    assert one == {"name": "avatar", "authors": ["A. Person"], "licenseUrl": "https://vrm.dev/licenses/1.0/"}
    assert (zero["author"], zero["allowedUserName"], zero["licenseName"]) == (
        "A. Person",
        "OnlyAuthor",
        "Redistribution_Prohibited",
    )
    meta = VrmMeta("avatar", "A. Person", "https://example.org/licence")
    names = anny_body().joint_names
    for encode, key in ((encode_vrm1, "otherLicenseUrl"), (encode_vrm0, "otherLicenseUrl")):
        assert b'"otherLicenseUrl":"https://example.org/licence"' in encode(files["glb"], names, meta), key


def test_the_gaze_starts_between_the_eyes(files: dict[str, GlbFile]) -> None:
    """The built-in body has its eyes 10 to 14 cm above the top of the neck and 8 to 12 cm in front of it."""
    x, y, z = extension(files["1.0"])["lookAt"]["offsetFromHeadBone"]
    assert (abs(x) < 1e-3, 0.10 < y < 0.14, 0.08 < z < 0.12) == (True, True, True)
    offset = extension(files["0.x"])["firstPerson"]["firstPersonBoneOffset"]  # Unity's axes: +Z is forward
    assert (offset["y"], offset["z"]) == pytest.approx((y, z))


def test_a_skeleton_that_is_no_humanoid_is_refused() -> None:
    with pytest.raises(ValueError, match="leftHand"):
        human_bones([name for name in anny_body().joint_names if name != "LeftHand"], "1.0")


def test_morphs_turn_with_the_mesh(files: dict[str, GlbFile], tmp_path: Path) -> None:
    """A morph of 1 cm to the front stays one on the torso; on the hands, which the T-pose turns, it is another."""
    document = GlbWriter.from_file(files["glb"])
    offsets = np.zeros((len(anny_body().vertices), 3), dtype=np.float32)
    offsets[:, 2] = 0.01
    primitive = document.json["meshes"][0]["primitives"][0]
    primitive["targets"] = [{"POSITION": document.add_sparse_array(offsets, bounds=True)}]
    (tmp_path / "morph.glb").write_bytes(document.to_bytes())
    (tmp_path / "morph.vrm").write_bytes(encode_vrm0(GlbFile(tmp_path / "morph.glb"), anny_body().joint_names, META))
    file = GlbFile(tmp_path / "morph.vrm")
    moved = file.accessor(file.gltf["meshes"][0]["primitives"][0]["targets"][0]["POSITION"])
    still = _weight_of(files["glb"], ("Hips", "Spine", "Spine1", "Head")) > 0.99999
    np.testing.assert_allclose(moved[still], [[0.0, 0.0, -0.01]] * still.sum(), atol=1e-6)
    hand = _weight_of(files["glb"], ("LeftHand",)) > 0.99999
    assert np.abs(moved[hand] - [0.0, 0.0, -0.01]).max() > 0.004


def test_a_root_joint_above_the_hips_changes_nothing(files: dict[str, GlbFile], tmp_path: Path) -> None:
    rooted = add_root_joint(files["glb"])
    for version, encode in (("1.0", encode_vrm1), ("0.x", encode_vrm0)):
        (tmp_path / "rooted.vrm").write_bytes(encode(rooted, anny_body().joint_names, META))
        posed, expected = RestPlayer(tmp_path / "rooted.vrm"), RestPlayer(files[version].path)
        assert bone_nodes(GlbFile(tmp_path / "rooted.vrm")) == bone_nodes(files[version])
        np.testing.assert_allclose(posed.posed_vertices(0.0), expected.posed_vertices(0.0), atol=1e-6)
        np.testing.assert_array_equal(posed.joint_m("root"), 0.0)


def test_the_khronos_validator_finds_no_issue(files: dict[str, GlbFile]) -> None:
    assert validator_issues(files["1.0"].path) == []
    # the name of version 0.x, "VRM", has no prefix of a vendor
    assert [issue["code"] for issue in validator_issues(files["0.x"].path)] == ["INVALID_EXTENSION_NAME_FORMAT"]
