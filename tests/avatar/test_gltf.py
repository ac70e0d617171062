"""The .glb, played by an independent implementation of glTF with scipy, and checked by the Khronos validator."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation, Slerp

from pipeline.avatar.gltf import MorphTargets, encode_glb
from pipeline.avatar.gltf_material import MaterialMaps, pack_specular_factor
from pipeline.avatar.rig import build_rig
from pipeline.avatar.rig_names import RigName
from pipeline.body.body import canonical_to_world
from pipeline.geometry.camera import project
from pipeline.geometry.skinning import linear_blend_skinning
from pipeline.io.glb import GlbFile
from pipeline.io.image import png_bytes
from tests.avatar.avatar_sample import sample_body, sample_camera, sample_maps, sample_motion, sample_skinned_mesh
from tests.tools.khronos import validator_issues

FRAMES = np.array([0, 3, 4, 9, 20, 31, 40])


@pytest.fixture(scope="module")
def glb_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("glb") / "avatar.glb"
    path.write_bytes(encoded())
    return path


def encoded(**changes: object) -> bytes:
    body = sample_body()
    parts = {
        "mesh": sample_skinned_mesh(body)[0],
        "rig": build_rig(body),
        "clips": {"capture": sample_motion(FRAMES)},
        "maps": sample_maps(),
        "camera": sample_camera(),
        "extras": {"unit": "metre"},
    }
    return encode_glb(**(parts | changes))


class Player:
    """Plays glTF 2.0 with scipy: chapters 3.7.3 (skins) and 3.11 (animations); no code of the exporter."""

    def __init__(self, path: Path) -> None:
        self.file = GlbFile(path)
        self.json = self.file.gltf

    def array(self, index: int) -> np.ndarray:
        values = self.file.accessor(index)
        return values[:, 0] if self.json["accessors"][index]["type"] == "SCALAR" else values

    def local_matrix(self, node: int, time_s: float) -> np.ndarray:
        description = self.json["nodes"][node]
        matrix = np.eye(4)
        matrix[:3, 3] = description.get("translation", [0, 0, 0])
        if "rotation" in description:
            matrix[:3, :3] = Rotation.from_quat(description["rotation"]).as_matrix()
        animation = self.json["animations"][0]
        for channel in animation["channels"]:
            if channel["target"]["node"] == node:
                sampler = animation["samplers"][channel["sampler"]]
                times, values = self.array(sampler["input"]), self.array(sampler["output"])
                time_s = np.clip(time_s, times[0], times[-1])
                if channel["target"]["path"] == "rotation":
                    matrix[:3, :3] = Slerp(times, Rotation.from_quat(values))(time_s).as_matrix()
                else:
                    matrix[:3, 3] = [np.interp(time_s, times, values[:, k]) for k in range(3)]
        return matrix

    def global_matrix(self, node: int, time_s: float) -> np.ndarray:
        parents = [n for n, value in enumerate(self.json["nodes"]) if node in value.get("children", [])]
        local = self.local_matrix(node, time_s)
        return self.global_matrix(parents[0], time_s) @ local if parents else local

    def posed_vertices(self, time_s: float) -> np.ndarray:
        skin = self.json["skins"][0]
        inverse_bind = self.array(skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
        joints = np.stack([self.global_matrix(node, time_s) for node in skin["joints"]]) @ inverse_bind
        attributes = self.json["meshes"][0]["primitives"][0]["attributes"]
        matrices = np.einsum(
            "vk,vkab->vab", self.array(attributes["WEIGHTS_0"]), joints[self.array(attributes["JOINTS_0"])]
        )
        points = self.array(attributes["POSITION"])
        return np.einsum("vab,vb->va", matrices[:, :3], np.c_[points, np.ones(len(points))])


def truth(row: int) -> np.ndarray:
    body = sample_body()
    transforms = canonical_to_world(body, sample_motion(FRAMES))
    posed = linear_blend_skinning(torch.from_numpy(body.vertices), torch.from_numpy(body.skin_weights), transforms)
    return posed[row].numpy()


@pytest.mark.parametrize("row", range(len(FRAMES)))
def test_playing_the_file_reproduces_the_poses(glb_path: Path, row: int) -> None:
    posed = Player(glb_path).posed_vertices(FRAMES[row] / 25.0)
    np.testing.assert_allclose(posed, truth(row), atol=2e-5)


def test_missing_frames_are_interpolated_along_the_shortest_arc(glb_path: Path) -> None:
    player = Player(glb_path)
    sampler = player.json["animations"][0]["samplers"]
    rotations = [track for track in (player.array(s["output"]) for s in sampler) if track.shape[1] == 4]
    assert len(rotations) == 2  # hips and spine: the head does not move and has no track
    assert all(np.all(np.sum(track[1:] * track[:-1], axis=1) > 0) for track in rotations)


def test_the_rest_pose_is_the_bind_pose(glb_path: Path) -> None:
    player = Player(glb_path)
    player.json["animations"] = [{"channels": []}]
    np.testing.assert_allclose(player.posed_vertices(0.0), sample_body().vertices, atol=1e-6)
    assert all(not {"rotation", "scale", "matrix"} & set(node) for node in player.json["nodes"][1:-1])


def test_the_mesh_node_is_a_scene_root_without_transform(glb_path: Path) -> None:
    document = GlbFile(glb_path).gltf
    (skinned,) = [node for node in document["nodes"] if "skin" in node]
    assert document["nodes"].index(skinned) in document["scenes"][0]["nodes"]
    assert set(skinned) == {"name", "mesh", "skin"}


def test_weights_sum_to_one_and_joints_of_zero_weight_are_zero(glb_path: Path) -> None:
    player = Player(glb_path)
    attributes = player.json["meshes"][0]["primitives"][0]["attributes"]
    weights, joints = player.array(attributes["WEIGHTS_0"]), player.array(attributes["JOINTS_0"])
    np.testing.assert_allclose(weights.sum(axis=1, dtype=np.float64), 1.0, atol=1e-7)
    assert not joints[weights == 0].any()


def test_uv_origin_is_top_left(glb_path: Path) -> None:
    player = Player(glb_path)
    uv = player.array(player.json["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"])
    expected = sample_skinned_mesh(sample_body())[0].uv
    np.testing.assert_allclose(uv, np.c_[expected[:, 0], 1.0 - expected[:, 1]], atol=1e-7)


def test_the_camera_node_projects_like_the_capture_camera(glb_path: Path) -> None:
    player = Player(glb_path)
    camera, (index,) = sample_camera(), [n for n, node in enumerate(player.json["nodes"]) if "camera" in node]
    in_camera = np.linalg.inv(player.global_matrix(index, 0.0)) @ np.array([0.4, 1.1, -3.0, 1.0])
    perspective = player.json["cameras"][0]["perspective"]
    focal = 1.0 / np.tan(0.5 * perspective["yfov"])
    ndc_x = focal / perspective["aspectRatio"] * in_camera[0] / -in_camera[2]
    ndc_y = focal * in_camera[1] / -in_camera[2]
    pixel, _ = project(torch.tensor([[0.4, 1.1, -3.0]]), camera)
    expected = pixel[0].numpy() - [camera.cx, camera.cy]  # the frustum of glTF is symmetric
    np.testing.assert_allclose([0.5 * camera.width * ndc_x, -0.5 * camera.height * ndc_y], expected, atol=1e-2)


def test_the_same_avatar_gives_the_same_bytes() -> None:
    assert encoded() == encoded()


def material_of(data: bytes, folder: Path) -> tuple[dict, list[str]]:
    (folder / "one.glb").write_bytes(data)
    document = GlbFile(folder / "one.glb").gltf
    return document["materials"][0]["extensions"], document["extensionsUsed"]


def test_a_matte_surface_has_specular_factor_zero(tmp_path: Path) -> None:
    extensions, used = material_of(encoded(maps=MaterialMaps(sample_maps().diffuse_png)), tmp_path)
    assert extensions == {"KHR_materials_specular": {"specularFactor": 0.0}}
    assert used == ["KHR_materials_specular"]


def test_a_specular_map_has_no_specular_colour(tmp_path: Path) -> None:
    extensions, _ = material_of(encoded(), tmp_path)
    assert extensions == {"KHR_materials_specular": {"specularTexture": {"index": 1}}}


def test_an_unlit_surface_has_no_other_extension(tmp_path: Path) -> None:
    """KHR_materials_specular "must not be used on a material that also uses KHR_materials_unlit"."""
    unlit = encoded(maps=replace(sample_maps(), unlit=True))
    assert material_of(unlit, tmp_path) == ({"KHR_materials_unlit": {}}, ["KHR_materials_unlit"])
    assert validator_issues(tmp_path / "one.glb") == []


def test_the_specular_factor_is_in_alpha() -> None:
    factor = np.random.default_rng(0).integers(0, 256, (5, 7), dtype=np.uint8)
    png = png_bytes(pack_specular_factor(factor))
    pixels = cv2.imdecode(np.frombuffer(png, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(pixels[..., 3], factor)
    assert (pixels[..., :3] == 255).all()


def test_times_must_increase() -> None:
    with pytest.raises(ValueError, match="increase"):
        encoded(clips={"capture": sample_motion(np.array([0, 5, 5]))})


@pytest.mark.parametrize("name", ["time_s", "rotations_wxyz", "root_translation_m"])
def test_values_that_are_not_finite_are_refused(name: str) -> None:
    values = getattr(sample_motion(FRAMES), name).copy()
    values[-1] = np.nan if name != "time_s" else np.inf
    with pytest.raises(ValueError, match="finite"):
        encoded(clips={"capture": replace(sample_motion(FRAMES), **{name: values})})


def test_zero_quaternions_are_refused() -> None:
    motion = sample_motion(FRAMES)
    motion.rotations_wxyz[3, 1] = 0.0
    with pytest.raises(ValueError, match="non-zero length"):
        encoded(clips={"capture": motion})


def test_more_than_65536_joints_are_refused() -> None:
    names = tuple(map(str, range(65537)))
    with pytest.raises(ValueError, match="65537"):
        encoded(rig=replace(build_rig(sample_body()), joint_names=names))


def test_a_zero_normal_points_up(tmp_path: Path) -> None:
    mesh = sample_skinned_mesh(sample_body())[0]
    normals = mesh.normals.copy()
    normals[4] = 0.0
    (tmp_path / "one.glb").write_bytes(encoded(mesh=replace(mesh, normals=normals)))
    player = Player(tmp_path / "one.glb")
    stored = player.array(player.json["meshes"][0]["primitives"][0]["attributes"]["NORMAL"])
    np.testing.assert_array_equal(stored[4], [0.0, 1.0, 0.0])
    np.testing.assert_allclose(np.linalg.norm(stored, axis=1), 1.0, atol=1e-6)


def test_trimesh_reads_the_same_surface(glb_path: Path) -> None:
    read = trimesh.load(glb_path, force="mesh", process=False)
    expected = sample_skinned_mesh(sample_body())[0]
    np.testing.assert_allclose(read.vertices, expected.positions_m, atol=1e-7)
    np.testing.assert_array_equal(read.faces, expected.faces)
    np.testing.assert_allclose(read.visual.uv, expected.uv, atol=1e-6)


def test_the_general_reader_finds_one_skinned_primitive(glb_path: Path) -> None:
    (primitive,) = GlbFile(glb_path).skinned_primitives()
    expected = sample_skinned_mesh(sample_body())[0]
    np.testing.assert_array_equal(primitive.joints, expected.joint_indices)
    np.testing.assert_allclose(primitive.weights, expected.joint_weights, atol=1e-6)
    assert (primitive.skin, primitive.material) == (0, 0)


def test_the_khronos_validator_finds_no_issue(glb_path: Path) -> None:
    assert validator_issues(glb_path) == []


def test_the_khronos_validator_finds_a_broken_accessor(glb_path: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken.glb"
    broken.write_bytes(glb_path.read_bytes().replace(b'"MAT4"', b'"VEC4"', 1))
    assert validator_issues(broken)


def test_morph_targets_have_names_and_the_displacements(tmp_path: Path) -> None:
    mesh = sample_skinned_mesh(sample_body())[0]
    moved = np.zeros((2, len(mesh.positions_m), 3), np.float32)
    moved[0, 5:9] = np.random.default_rng(0).normal(size=(4, 3))
    turned = 0.1 * moved[..., ::-1]
    path = tmp_path / "morphs.glb"
    path.write_bytes(encoded(mesh=replace(mesh, morphs=MorphTargets(("jawOpen", "viseme_sil"), moved, None, turned))))
    file = GlbFile(path)
    (stored,) = file.gltf["meshes"]
    assert stored["extras"]["targetNames"] == ["jawOpen", "viseme_sil"]
    assert stored["weights"] == [0.0, 0.0]
    targets = [target["POSITION"] for target in stored["primitives"][0]["targets"]]
    for index, expected in zip(targets, moved, strict=True):
        assert "sparse" in file.gltf["accessors"][index]
        np.testing.assert_array_equal(file.accessor(index), expected)
    for target, expected in zip(stored["primitives"][0]["targets"], turned, strict=True):
        np.testing.assert_array_equal(file.accessor(target["NORMAL"]), expected)
    assert validator_issues(path) == []


@pytest.mark.parametrize("names", ["plain", "unreal"])
def test_eyes_are_nodes_of_the_head_at_their_centres(tmp_path: Path, names: RigName) -> None:
    mesh = sample_skinned_mesh(sample_body())[0]
    eyes_m, moved = np.array([[0.03, 1.7, 0.1], [-0.03, 1.7, 0.1]]), np.zeros((1, len(mesh.positions_m), 3), np.float32)
    rig = build_rig(sample_body(), names)
    path = tmp_path / "eyes.glb"
    path.write_bytes(encoded(mesh=replace(mesh, morphs=MorphTargets(("jawOpen",), moved, eyes_m)), rig=rig))
    scene = trimesh.load(path, process=False)
    for name, centre_m in zip(("LeftEye", "RightEye"), eyes_m, strict=True):
        matrix, _ = scene.graph[name]
        np.testing.assert_allclose(matrix[:3, 3], centre_m, atol=1e-6)
    nodes = GlbFile(path).gltf["nodes"]
    (head,) = [node for node in nodes if node["name"] == rig.joint_names[sample_body().joint("Head")]]
    assert [nodes[child]["name"] for child in head["children"]] == ["LeftEye", "RightEye"]
    assert validator_issues(path) == []
