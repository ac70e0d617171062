"""The USDZ, skinned by USD's own implementation and checked by its validators."""

import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.avatar.formats.usdz import TIME_CODES_PER_SECOND, write_usdz
from pipeline.io.glb import GlbFile
from pipeline.io.glb_writer import GlbWriter
from pipeline.io.image import png_bytes
from tests.avatar.formats.column import FRAMES, add_root_joint, column_glb
from tests.avatar.test_gltf import Player

pytest.importorskip("pxr", reason="usd-core is not installed: make venv EXTRA=usdz")
from pxr import Usd, UsdGeom, UsdShade, UsdSkel, UsdValidation, Vt  # noqa: E402


@pytest.fixture(scope="module")
def glb(tmp_path_factory: pytest.TempPathFactory) -> GlbFile:
    return column_glb(tmp_path_factory.mktemp("usdz"))


@pytest.fixture(scope="module")
def path(glb: GlbFile) -> Path:
    path = glb.path.with_suffix(".usdz")
    write_usdz(path, glb)
    return path


def skinned_points(stage: Usd.Stage, time_code: float) -> np.ndarray:
    cache = UsdSkel.Cache()
    cache.Populate(UsdSkel.Root(stage.GetDefaultPrim()), Usd.PrimDefaultPredicate)
    skeleton = cache.GetSkelQuery(UsdSkel.Skeleton(stage.GetPrimAtPath("/Avatar/Skeleton")))
    mesh = stage.GetPrimAtPath("/Avatar/Mesh")
    points = Vt.Vec3fArray(UsdGeom.Mesh(mesh).GetPointsAttr().Get())
    transforms = skeleton.ComputeSkinningTransforms(time_code)
    assert cache.GetSkinningQuery(mesh).ComputeSkinnedPoints(transforms, points, time_code)
    return np.array(points)


@pytest.mark.parametrize("frame", [0, 3, 10])
def test_usd_poses_the_mesh_as_a_gltf_viewer_does(glb: GlbFile, path: Path, frame: int) -> None:
    stage, time_s = Usd.Stage.Open(str(path)), float(FRAMES[frame]) / 25.0
    posed = skinned_points(stage, time_s * TIME_CODES_PER_SECOND)
    np.testing.assert_allclose(posed, Player(glb.path).posed_vertices(time_s), atol=2e-6)


def test_the_clip_has_the_length_of_the_gltf(path: Path) -> None:
    stage = Usd.Stage.Open(str(path))
    seconds = (stage.GetEndTimeCode() - stage.GetStartTimeCode()) / stage.GetTimeCodesPerSecond()
    assert seconds == pytest.approx(FRAMES[-1] / 25.0)
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert UsdGeom.GetStageUpAxis(stage) == "Y"


def test_texture_coordinates_and_texture(glb: GlbFile, path: Path) -> None:
    stage = Usd.Stage.Open(str(path))
    coordinates = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/Avatar/Mesh")).GetPrimvar("st").Get()
    uv = glb.skinned_primitives()[0].uv
    np.testing.assert_allclose(np.array(coordinates), np.c_[uv[:, 0], 1.0 - uv[:, 1]], atol=1e-7)
    with zipfile.ZipFile(path) as package:
        assert package.read("diffuse.png") == glb.image_bytes(0)
    bound = UsdShade.MaterialBindingAPI(stage.GetPrimAtPath("/Avatar/Mesh")).ComputeBoundMaterial()[0]
    surface = bound.ComputeSurfaceSource()[0]
    assert surface.GetInput("diffuseColor").GetConnectedSource()[0].GetPath().name == "Diffuse"
    assert surface.GetInput("roughness").Get() == pytest.approx(0.9)


def test_the_package_is_stored_aligned_and_starts_with_the_stage(path: Path) -> None:
    with zipfile.ZipFile(path) as package:
        members = package.infolist()
    assert [member.filename for member in members] == ["avatar.usdc", "diffuse.png", "specular.png"]
    data = path.read_bytes()
    for member in members:
        assert member.compress_type == zipfile.ZIP_STORED
        name, extra = (int.from_bytes(data[member.header_offset + at :][:2], "little") for at in (26, 28))
        assert (member.header_offset + 30 + name + extra) % 64 == 0


def test_usd_finds_no_fault(path: Path) -> None:
    context = UsdValidation.ValidationContext(UsdValidation.ValidationRegistry().GetOrLoadAllValidators())
    assert [error.GetMessage() for error in context.Validate(Usd.Stage.Open(str(path)))] == []


def test_the_same_avatar_gives_the_same_bytes(glb: GlbFile, path: Path, tmp_path: Path) -> None:
    write_usdz(tmp_path / "again.usdz", glb)
    assert (tmp_path / "again.usdz").read_bytes() == path.read_bytes()


def test_a_root_joint_that_comes_last_in_the_skin_is_first_in_usd(glb: GlbFile, tmp_path: Path) -> None:
    rooted = add_root_joint(glb)
    write_usdz(tmp_path / "rooted.usdz", rooted)
    stage = Usd.Stage.Open(str(tmp_path / "rooted.usdz"))
    joints = UsdSkel.Skeleton(stage.GetPrimAtPath("/Avatar/Skeleton")).GetJointsAttr().Get()
    assert list(joints) == ["root", "root/Hips", "root/Hips/Spine", "root/Hips/Spine/Head"]
    time_s = float(FRAMES[3]) / 25.0
    posed = skinned_points(stage, time_s * TIME_CODES_PER_SECOND)
    np.testing.assert_allclose(posed, Player(glb.path).posed_vertices(time_s), atol=2e-6)


def test_without_a_clip_it_is_the_rest_pose(glb: GlbFile, tmp_path: Path) -> None:
    document = GlbWriter.from_file(glb)
    del document.json["animations"]
    (tmp_path / "still.glb").write_bytes(document.to_bytes())
    write_usdz(tmp_path / "still.usdz", GlbFile(tmp_path / "still.glb"))
    posed = skinned_points(Usd.Stage.Open(str(tmp_path / "still.usdz")), 0.0)
    np.testing.assert_allclose(posed, glb.skinned_primitives()[0].positions, atol=1e-6)


def read_map(path: Path, stage: Usd.Stage, name: str) -> np.ndarray:
    """The values that an input of the surface gets from its map: scale times texel plus bias."""
    surface = UsdShade.Shader(stage.GetPrimAtPath("/Avatar/Material/Surface"))
    sampler = UsdShade.Shader(surface.GetInput(name).GetConnectedSource()[0].GetPrim())
    assert sampler.GetInput("sourceColorSpace").Get() == "raw"
    with zipfile.ZipFile(path) as package:
        data = np.frombuffer(package.read(sampler.GetInput("file").Get().path), np.uint8)
    texels = cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1] / 255.0
    scale, bias = (sampler.GetInput(key) for key in ("scale", "bias"))
    return texels * (np.array(scale.Get())[:3] if scale else 1.0) + (np.array(bias.Get())[:3] if bias else 0.0)


def test_the_specular_factor_scales_the_reflectance_of_a_dielectric(glb: GlbFile, path: Path) -> None:
    stage = Usd.Stage.Open(str(path))
    surface = UsdShade.Shader(stage.GetPrimAtPath("/Avatar/Material/Surface"))
    assert surface.GetInput("useSpecularWorkflow").Get() == 1
    factor = glb.image_pixels(1)[..., 3:] / 255.0
    np.testing.assert_allclose(read_map(path, stage, "specularColor"), 0.04 * np.repeat(factor, 3, axis=2), atol=1e-6)


def test_a_surface_without_highlights_reflects_nothing(glb: GlbFile, tmp_path: Path) -> None:
    document = GlbWriter.from_file(glb)
    document.json["materials"][0]["extensions"] = {"KHR_materials_specular": {"specularFactor": 0.0}}
    (tmp_path / "matte.glb").write_bytes(document.to_bytes())
    write_usdz(tmp_path / "matte.usdz", GlbFile(tmp_path / "matte.glb"))
    stage = Usd.Stage.Open(str(tmp_path / "matte.usdz"))
    surface = UsdShade.Shader(stage.GetPrimAtPath("/Avatar/Material/Surface"))
    assert tuple(surface.GetInput("specularColor").Get()) == (0.0, 0.0, 0.0)


def test_the_normal_map_is_that_of_the_glb(glb: GlbFile, tmp_path: Path) -> None:
    document = GlbWriter.from_file(glb)
    pixels = np.random.default_rng(0).integers(0, 256, (16, 16, 3), dtype=np.uint8)
    view = document.add_bytes(png_bytes(pixels))
    image = document.add("images", {"mimeType": "image/png", "bufferView": view})
    document.json["materials"][0]["normalTexture"] = {"index": document.add("textures", {"source": image})}
    (tmp_path / "bumpy.glb").write_bytes(document.to_bytes())
    write_usdz(tmp_path / "bumpy.usdz", GlbFile(tmp_path / "bumpy.glb"))
    stage = Usd.Stage.Open(str(tmp_path / "bumpy.usdz"))
    np.testing.assert_allclose(read_map(tmp_path / "bumpy.usdz", stage, "normal"), pixels / 127.5 - 1.0, atol=1e-6)
    context = UsdValidation.ValidationContext(UsdValidation.ValidationRegistry().GetOrLoadAllValidators())
    assert [error.GetMessage() for error in context.Validate(stage)] == []


def test_the_roughness_map_is_that_of_the_glb(glb: GlbFile, tmp_path: Path) -> None:
    document = GlbWriter.from_file(glb)
    pixels = np.random.default_rng(1).integers(0, 256, (16, 16, 3), dtype=np.uint8)
    image = document.add("images", {"mimeType": "image/png", "bufferView": document.add_bytes(png_bytes(pixels))})
    texture = {"index": document.add("textures", {"source": image})}
    document.json["materials"][0]["pbrMetallicRoughness"]["metallicRoughnessTexture"] = texture
    (tmp_path / "two.glb").write_bytes(document.to_bytes())
    write_usdz(tmp_path / "two.usdz", GlbFile(tmp_path / "two.glb"))
    stage = Usd.Stage.Open(str(tmp_path / "two.usdz"))
    roughness = read_map(tmp_path / "two.usdz", stage, "roughness")[..., 0]
    np.testing.assert_allclose(roughness, pixels[..., 1] / 255.0, atol=1e-6)
    context = UsdValidation.ValidationContext(UsdValidation.ValidationRegistry().GetOrLoadAllValidators())
    assert [error.GetMessage() for error in context.Validate(stage)] == []


def test_an_unlit_surface_emits_its_colour(glb: GlbFile, tmp_path: Path) -> None:
    document = GlbWriter.from_file(glb)
    document.json["materials"][0]["extensions"] = {"KHR_materials_unlit": {}}
    (tmp_path / "unlit.glb").write_bytes(document.to_bytes())
    write_usdz(tmp_path / "unlit.usdz", GlbFile(tmp_path / "unlit.glb"))
    stage = Usd.Stage.Open(str(tmp_path / "unlit.usdz"))
    surface = UsdShade.Shader(stage.GetPrimAtPath("/Avatar/Material/Surface"))
    assert surface.GetInput("emissiveColor").HasConnectedSource()
    assert tuple(surface.GetInput("diffuseColor").Get()) == (0.0, 0.0, 0.0)
