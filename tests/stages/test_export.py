"""The export stage on a body with true mesh and poses and a hand-written texture."""

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from pydantic import ValidationError

from pipeline.avatar.finished_run import load_textured_avatar
from pipeline.body.body import canonical_to_world
from pipeline.core.errors import UserError
from pipeline.geometry.atlas import Atlas
from pipeline.geometry.creases import find_creases
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.skinning import linear_blend_skinning, top_k_weights
from pipeline.io.glb import GlbFile
from pipeline.io.image import read_gray, read_rgb, to_float, write_gray, write_rgb
from pipeline.mesh.files import MeshArtifact, load_mesh, save_mesh
from pipeline.template.files import TEMPLATE_NPZ, save_template
from pipeline.template.regions import template_quads
from pipeline.texture.files import TextureArtifact, TextureFormat, load_texture, save_texture
from pipeline.texture.light import Highlights, VideoLight, directional_light, save_light
from stages.export import STAGE as EXPORT
from tests.avatar.test_gltf import Player
from tests.field.scene import PaintedScene, painted_scene
from tests.stages.painted_run import make_run, save_known_template
from tests.tools.khronos import validator_issues

TEXTURE_PX = 64
FRAME = 8


@pytest.fixture(scope="module")
def scene() -> PaintedScene:
    return painted_scene(frames=10, height_px=32)


@pytest.fixture(scope="module")
def inputs(scene: PaintedScene, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The stages before export; in the atlas every face is a chart, so all vertices are duplicated."""
    folder = tmp_path_factory.mktemp("run")
    inputs = make_run(folder, scene.body, scene.motion, scene.camera, scene.images, scene.masks)
    random = np.random.default_rng(0)
    faces = scene.body.faces
    faces_uv = np.arange(faces.size, dtype=np.int32).reshape(-1, 3)
    atlas = Atlas(random.uniform(size=(faces.size, 2)).astype(np.float32), faces_uv, faces.reshape(-1).astype(np.int32))
    diffuse = to_float(random.integers(0, 256, (TEXTURE_PX, TEXTURE_PX, 3), dtype=np.uint8))
    blank = np.zeros((TEXTURE_PX, TEXTURE_PX), dtype=np.uint8)
    (folder / "texture").mkdir()
    save_texture(
        folder / "texture",
        TextureArtifact(atlas, diffuse, to_float(blank), blank, VideoLight.uniform(3), Highlights.none()),
    )
    save_known_template(folder / "texture", scene.body)
    return inputs | {"texture": folder / "texture"}


@pytest.fixture(scope="module")
def exported(inputs: dict[str, Path]) -> tuple[Path, dict[str, float]]:
    out = inputs["mesh"].parent / "export"
    out.mkdir()
    return out, dict(EXPORT.run(inputs, out, EXPORT.config()))


def test_the_stage_writes_its_files_and_no_other(scene: PaintedScene, exported: tuple[Path, dict[str, float]]) -> None:
    out, metrics = exported
    assert sorted(path.name for path in out.iterdir()) == sorted(EXPORT.makes)
    assert metrics["glb_bytes"] == (out / "avatar.glb").stat().st_size
    assert metrics["animation_s"] == pytest.approx(scene.motion.time_s[-1])
    assert metrics["vertices"] == scene.body.faces.size


def test_the_khronos_validator_finds_no_issue(exported: tuple[Path, dict[str, float]]) -> None:
    assert validator_issues(exported[0] / "avatar.glb") == []


def test_the_animation_reproduces_the_motion_on_a_floor_at_zero(
    scene: PaintedScene, exported: tuple[Path, dict[str, float]]
) -> None:
    player = Player(exported[0] / "avatar.glb")
    posed = player.posed_vertices(scene.motion.time_s[FRAME])
    transforms = canonical_to_world(scene.body, scene.motion)[FRAME : FRAME + 1]
    weights = torch.from_numpy(scene.body.skin_weights)
    world = linear_blend_skinning(torch.from_numpy(scene.body.vertices), weights, transforms)[0].numpy()
    offset_m = np.array(player.json["asset"]["extras"]["world_to_scene_translation_m"])
    atlas = load_texture(exported[0].parent / "texture").atlas
    # four influences per vertex instead of all: millimetres at the joints
    assert np.abs(posed - (world + offset_m)[atlas.vertex_of_uv]).max() < 0.01
    assert abs(posed[:, 1].min()) < 0.12
    assert np.abs(posed.mean(axis=0)[[0, 2]]).max() < 0.15


def test_the_glb_embeds_the_maps(exported: tuple[Path, dict[str, float]]) -> None:
    png = (exported[0] / "avatar_diffuse.png").read_bytes()
    assert png == (exported[0].parent / "texture" / "diffuse.png").read_bytes()
    embedded = GlbFile(exported[0] / "avatar.glb").base_colour(0)
    np.testing.assert_array_equal(embedded, read_rgb(exported[0] / "avatar_diffuse.png"))


@pytest.mark.parametrize(("texture_format", "suffix"), [("png16", ".png"), ("exr", ".exr")])
def test_the_obj_refers_to_the_deepest_maps_and_the_glb_embeds_eight_bits(
    inputs: dict[str, Path], tmp_path: Path, texture_format: TextureFormat, suffix: str
) -> None:
    texture, out = tmp_path / "texture", tmp_path / "export"
    texture.mkdir()
    out.mkdir()
    artifact = load_texture(inputs["texture"])
    amplitude = np.zeros((TEXTURE_PX, TEXTURE_PX), dtype=np.float32)
    amplitude[:, TEXTURE_PX // 2 :] = 0.01
    diffuse = np.random.default_rng(1).uniform(size=(TEXTURE_PX, TEXTURE_PX, 3)).astype(np.float32)
    save_texture(texture, replace(artifact, diffuse=diffuse, specular=amplitude), texture_format)
    shutil.copyfile(inputs["texture"] / TEMPLATE_NPZ, texture / TEMPLATE_NPZ)
    EXPORT.run(inputs | {"texture": texture}, out, EXPORT.config())
    material = (out / "avatar.mtl").read_text().splitlines()
    assert {f"map_Kd avatar_diffuse{suffix}", f"map_Ks avatar_specular{suffix}"} <= set(material)
    for name in ("diffuse", "specular"):
        assert (out / f"avatar_{name}{suffix}").read_bytes() == (texture / f"{name}{suffix}").read_bytes()
    assert validator_issues(out / "avatar.glb") == []
    embedded = cv2.imdecode(np.frombuffer(GlbFile(out / "avatar.glb").image_bytes(0), np.uint8), cv2.IMREAD_UNCHANGED)
    assert embedded.dtype == np.uint8
    np.testing.assert_allclose(embedded[..., ::-1] / 255.0, diffuse, atol=0.0023)


def test_highlights_become_a_specular_factor_unless_the_surface_is_unlit(
    inputs: dict[str, Path], tmp_path: Path
) -> None:
    specular = shutil.copytree(inputs["texture"], tmp_path / "texture")
    half = TEXTURE_PX // 2
    amplitude = np.zeros((TEXTURE_PX, TEXTURE_PX), dtype=np.uint8)
    amplitude[:, half:] = 10
    write_gray(specular / "specular.png", amplitude)
    towards = (0.0, 0.0, 1.0)
    save_light(specular / "light.npz", directional_light(towards, 0.3), Highlights(np.array(towards), 24.0))
    materials = []
    for name, unlit in (("lit", False), ("unlit", True)):
        (tmp_path / name).mkdir()
        EXPORT.run(inputs | {"texture": specular}, tmp_path / name, EXPORT.config(unlit=unlit))
        glb = GlbFile(tmp_path / name / "avatar.glb")
        materials.append((set(glb.gltf["materials"][0]["extensions"]), len(glb.gltf["images"])))
        if not unlit:
            alpha = cv2.imdecode(np.frombuffer(glb.image_bytes(1), np.uint8), cv2.IMREAD_UNCHANGED)[..., 3]
            assert not alpha[:, :half].any()
            # strength * roughness^4 / 0.01, where exponent 24 has roughness (2 / 26)^(1/4)
            assert np.median(alpha[:, half:]) == pytest.approx(255 * (10 / 255) * (2 / 26) / 0.01, abs=1.0)
            light = glb.gltf["asset"]["extras"]["video_light"]
            assert light["coefficients"][0] == pytest.approx([0.3] * 3)
            assert light["key_direction"] == [0.0, 0.0, 1.0]
            roughness = glb.gltf["materials"][0]["pbrMetallicRoughness"]["roughnessFactor"]
            assert roughness == pytest.approx((2 / 26) ** 0.25, rel=1e-6)
    assert materials == [({"KHR_materials_specular"}, 2), ({"KHR_materials_unlit"}, 1)]


def test_two_shines_are_a_roughness_map_beside_the_specular_factor(inputs: dict[str, Path], tmp_path: Path) -> None:
    """Three parts: two with the roughness of their lobes, a matte one with that of the configuration."""
    texture, third = shutil.copytree(inputs["texture"], tmp_path / "texture"), TEXTURE_PX // 4
    towards = np.array([0.0, 0.0, 1.0], np.float32)
    strength, roughness = np.full((2, TEXTURE_PX, TEXTURE_PX), 0.02, dtype=np.float32)
    strength[:, 2 * third :] = 0.0
    roughness[:, :third], roughness[:, third:] = 0.4, 0.6
    artifact = replace(load_texture(texture), light=directional_light((0.0, 0.0, 1.0), 0.3))
    artifact = replace(artifact, highlights=Highlights(towards, 30.0), specular=strength, roughness=roughness)
    save_texture(texture, artifact)
    for name, unlit in (("lit", False), ("unlit", True)):
        (tmp_path / name).mkdir()
        EXPORT.run(inputs | {"texture": texture}, tmp_path / name, EXPORT.config(unlit=unlit, topology="template"))
        assert validator_issues(tmp_path / name / "avatar.glb") == []
    glb = GlbFile(tmp_path / "lit" / "avatar.glb")
    material = glb.gltf["materials"][0]
    optics, specular = material["pbrMetallicRoughness"], material["extensions"]["KHR_materials_specular"]
    assert (optics["roughnessFactor"], optics["metallicFactor"]) == (1.0, 0.0)
    pixels, factor = (
        glb.image_pixels(glb.gltf["textures"][each["index"]]["source"])
        for each in (optics["metallicRoughnessTexture"], specular["specularTexture"])
    )
    assert not pixels[..., 2].any()
    for columns, expected in ((slice(third), 0.4), (slice(third, 2 * third), 0.6), (slice(2 * third, None), 0.85)):
        np.testing.assert_array_equal(pixels[:, columns, 1], round(255 * expected))
        lit = 0.02 * expected**4 / 0.01 if expected < 0.8 else 0.0
        np.testing.assert_allclose(factor[:, columns, 3] / 255.0, lit, atol=0.006)
    assert len(GlbFile(tmp_path / "unlit" / "avatar.glb").gltf["images"]) == 1
    material_lines = (tmp_path / "lit" / "avatar.mtl").read_text().splitlines()
    assert {"Ns 30", "map_Pr avatar_roughness.png"} <= set(material_lines)
    assert "map_Pr wrapped_roughness.png" in (tmp_path / "lit" / "wrapped.mtl").read_text()
    wrapped = read_gray(tmp_path / "lit" / "wrapped_roughness.png")
    assert {102, 153} <= set(np.unique(wrapped).tolist())


def test_a_normal_map_is_exported_with_tangents_and_the_formats_accept_it(
    inputs: dict[str, Path], tmp_path: Path
) -> None:
    texture, out = shutil.copytree(inputs["texture"], tmp_path / "texture"), tmp_path / "export"
    out.mkdir()
    pixels = np.random.default_rng(2).integers(100, 156, (TEXTURE_PX // 2, TEXTURE_PX // 2, 3), dtype=np.uint8)
    pixels[..., 2] = 250
    write_rgb(texture / "normal.png", pixels)
    EXPORT.run(inputs | {"texture": texture}, out, EXPORT.config(formats="vrm", face=False))
    assert "norm avatar_normal.png" in (out / "avatar.mtl").read_text().splitlines()
    for name in ("avatar.glb", "avatar.vrm"):
        file = GlbFile(out / name)
        index = file.gltf["textures"][file.gltf["materials"][0]["normalTexture"]["index"]]["source"]
        np.testing.assert_array_equal(file.image_pixels(index), pixels)
        attributes = file.gltf["meshes"][0]["primitives"][0]["attributes"]
        tangents, normals = file.accessor(attributes["TANGENT"]), file.accessor(attributes["NORMAL"])
        np.testing.assert_allclose(np.linalg.norm(tangents[:, :3], axis=1), 1.0, atol=1e-5)
        assert np.abs(np.sum(tangents[:, :3] * normals, axis=1)).max() < 0.1
    for name in ("avatar.glb", "avatar.vrm"):
        assert validator_issues(out / name) == []


@pytest.mark.slow
def test_further_formats_are_written_and_the_glb_stays(
    inputs: dict[str, Path], exported: tuple[Path, dict[str, float]], tmp_path: Path
) -> None:
    config = EXPORT.config(formats="vrm, lod", author="A. Person")
    assert config.formats == ("vrm", "lod")
    EXPORT.run(inputs, tmp_path, config)
    made = {path.name for path in tmp_path.iterdir()}
    assert made == {*EXPORT.makes, "avatar.vrm", "avatar_lod1.glb", "avatar_lod2.glb"}
    assert (tmp_path / "avatar.glb").read_bytes() == (exported[0] / "avatar.glb").read_bytes()
    assert GlbFile(tmp_path / "avatar.vrm").gltf["extensions"]["VRMC_vrm"]["meta"]["authors"] == ["A. Person"]


@pytest.mark.parametrize("formats", ["fbx", ["vrm", "glb"], 3])
def test_unknown_formats_are_refused(formats: object) -> None:
    with pytest.raises(ValidationError, match="formats"):
        EXPORT.config(formats=formats)


def test_a_format_without_its_package_is_refused_before_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeline.avatar.formats.write.find_spec", lambda module: None)
    with pytest.raises(ValidationError, match="EXTRA=usdz"):
        EXPORT.config(formats=["vrm", "usdz"])


@pytest.mark.parametrize("unlit", [False, True])
def test_the_khronos_validator_accepts_a_specular_map(unlit: bool, inputs: dict[str, Path], tmp_path: Path) -> None:
    specular = shutil.copytree(inputs["texture"], tmp_path / "texture")
    write_gray(specular / "specular.png", np.full((TEXTURE_PX, TEXTURE_PX), 9, dtype=np.uint8))
    EXPORT.run(inputs | {"texture": specular}, tmp_path, EXPORT.config(unlit=unlit))
    assert validator_issues(tmp_path / "avatar.glb") == []


def test_the_t_pose_is_that_of_both_files_and_the_clips_are_the_same(
    scene: PaintedScene, inputs: dict[str, Path], exported: tuple[Path, dict[str, float]], tmp_path: Path
) -> None:
    EXPORT.run(inputs, tmp_path, EXPORT.config(rest_pose="t", rig="unreal"))
    player, other = Player(tmp_path / "avatar.glb"), Player(exported[0] / "avatar.glb")
    positions = player.array(player.json["meshes"][0]["primitives"][0]["attributes"]["POSITION"])
    lines = (tmp_path / "avatar.obj").read_text().splitlines()
    obj = np.array([line.split()[1:] for line in lines if line.startswith("v ")], dtype=float)
    atlas = load_texture(inputs["texture"]).atlas
    np.testing.assert_allclose(positions, obj[atlas.vertex_of_uv], atol=2e-6)
    assert np.ptp(positions[:, 0]) > np.ptp(scene.body.vertices[:, 0]) + 0.3
    assert [animation["name"] for animation in player.json["animations"]] == ["capture", "idle"]
    assert validator_issues(tmp_path / "avatar.glb") == []
    time_s = scene.motion.time_s[FRAME]
    for one, two in (("pelvis", "Hips"), ("hand_l", "LeftHand"), ("foot_r", "RightFoot")):
        places = [
            file.global_matrix([node.get("name") for node in file.json["nodes"]].index(name), time_s)[:3, 3]
            for file, name in ((player, one), (other, two))
        ]
        np.testing.assert_allclose(*places, atol=2e-5)


@pytest.mark.parametrize("rest_pose", ["a", "t"])
def test_the_rest_pose_of_every_file_stands_on_the_soles_of_the_shoes(
    rest_pose: str, inputs: dict[str, Path], scene: PaintedScene, tmp_path: Path
) -> None:
    """They are 2 cm below the feet of the body model, which stand on y = 0 in the canonical space; clips stay.

    Vertices between joints move by millimetres with the pose in which they are bound, others do not.
    """
    mesh, out = shutil.copytree(inputs["mesh"], tmp_path / "mesh"), tmp_path / "export"
    out.mkdir()
    whole = load_mesh(mesh)
    vertices = whole.mesh.vertices.copy()
    vertices[:, 1] -= 0.02 * (vertices[:, 1] < vertices[:, 1].min() + 0.05)
    save_mesh(mesh, replace(whole, mesh=Mesh(vertices, whole.mesh.faces)))
    EXPORT.run(inputs | {"mesh": mesh}, out, EXPORT.config(rest_pose=rest_pose, topology="template", face=False))
    for path in sorted(out.glob("*.glb")):
        part = GlbFile(path).skinned_primitives()[0]
        assert part.positions[:, 1].min() == pytest.approx(0.0, abs=5e-4), path
        rest = Player(path)
        rest.json["animations"] = [{"channels": []}]
        np.testing.assert_allclose(rest.posed_vertices(0.0), part.positions, atol=5e-6)
        assert validator_issues(path) == []
    for path in sorted(out.glob("*.obj")):
        heights = [float(line.split()[2]) for line in path.read_text().splitlines() if line.startswith("v ")]
        assert min(heights) == pytest.approx(0.0, abs=5e-4), path
    player = Player(out / "avatar.glb")
    transforms = canonical_to_world(scene.body, scene.motion)[FRAME : FRAME + 1]
    weights = whole.dense_skin_weights(len(scene.body.joint_names))
    world = linear_blend_skinning(torch.from_numpy(vertices), weights, transforms)[0].numpy()
    world += player.json["asset"]["extras"]["world_to_scene_translation_m"]
    played = player.posed_vertices(scene.motion.time_s[FRAME])
    source = load_texture(inputs["texture"]).atlas.vertex_of_uv
    of_one_joint = weights.numpy().max(axis=1)[source] > 0.9999
    assert of_one_joint.mean() > 0.3
    np.testing.assert_allclose(played[of_one_joint], world[source][of_one_joint], atol=2e-5)


def test_the_wrapped_template_is_written_as_quads_and_as_an_animated_glb(
    inputs: dict[str, Path], tmp_path: Path
) -> None:
    EXPORT.run(inputs, tmp_path, EXPORT.config(topology="template"))
    lines = (tmp_path / "wrapped.obj").read_text().splitlines()
    faces = [line.split()[1:] for line in lines if line.startswith("f ")]
    assert {len(corners) for corners in faces} == {4}
    assert len(faces) == len(template_quads())
    assert "map_Kd wrapped_diffuse.png" in (tmp_path / "wrapped.mtl").read_text()
    glb = GlbFile(tmp_path / "wrapped.glb")
    assert [animation["name"] for animation in glb.gltf["animations"]] == ["capture", "idle"]
    np.testing.assert_array_equal(glb.base_colour(0), read_rgb(tmp_path / "wrapped_diffuse.png"))
    assert validator_issues(tmp_path / "wrapped.glb") == []


def test_a_body_of_a_model_file_is_not_wrapped(inputs: dict[str, Path], tmp_path: Path) -> None:
    texture = tmp_path / "texture"
    shutil.copytree(inputs["texture"], texture)
    save_template(texture, None)
    with pytest.raises(UserError, match="needs the built-in body"):
        EXPORT.run(inputs | {"texture": texture}, tmp_path, EXPORT.config(topology="template"))


def test_the_glb_is_shaded_like_the_report(inputs: dict[str, Path], scene: PaintedScene, tmp_path: Path) -> None:
    """A brim around the waist has sharp folds, where both sides have normals of their own."""
    body = scene.body
    vertices = body.vertices.copy()
    waist = np.abs(vertices[:, 1] - 1.05) < 0.012
    vertices[waist, 0] *= 1.5
    vertices[waist, 2] *= 1.8
    mesh = shutil.copytree(inputs["mesh"], tmp_path / "mesh")
    folded = Mesh(vertices, body.faces)
    assert find_creases(folded).on_fold().sum() > 40
    save_mesh(mesh, MeshArtifact(folded, *top_k_weights(body.skin_weights), np.full_like(vertices, 0.5)))
    (tmp_path / "export").mkdir()
    EXPORT.run(inputs | {"mesh": mesh}, tmp_path / "export", EXPORT.config(face=False))
    avatar = load_textured_avatar(mesh, inputs["texture"])
    shown = Mesh(avatar.vertices.numpy(), avatar.faces.numpy())
    player = Player(tmp_path / "export" / "avatar.glb")
    attributes = player.json["meshes"][0]["primitives"][0]["attributes"]
    written_m, written = (player.array(attributes[name]) for name in ("POSITION", "NORMAL"))
    corners = avatar.faces.numpy().ravel()
    vertex_of_uv = np.zeros(len(avatar.uv), dtype=int)
    vertex_of_uv[avatar.faces_uv.numpy().ravel()] = corners
    assert len(written) == len(vertex_of_uv)
    np.testing.assert_allclose(written_m, shown.vertices[vertex_of_uv], atol=1e-5)
    cosine = np.sum(written * shown.vertex_normals()[vertex_of_uv], axis=1)
    assert cosine.min() > 0.999
