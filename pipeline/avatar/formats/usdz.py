"""Convert the avatar's .glb to USDZ: skinned mesh, skeleton, texture and the first clip, for Quick Look and USD tools.

Quick Look plays one skeletal animation, in a loop; without a clip it shows the rest pose. The specular factor becomes
the colour of UsdPreviewSurface's specular workflow, whose reflection at grazing angles it does not scale.

References: https://openusd.org/release/api/usd_skel_page_front.html and https://openusd.org/release/spec_usdpreviewsurface.html.
"""

import os
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from pipeline.io.glb import GlbFile, Primitive
from pipeline.io.image import png_bytes

TIME_CODES_PER_SECOND = 30.0
DIELECTRIC_REFLECTANCE = 0.04
"""Reflectance at normal incidence of glTF's dielectric, which the specular factor scales."""

_MEMBER_TIME_S = 1_000_000_000
"""Time stamp of the members of the package, s since 1970: the same avatar gives the same bytes."""

_ROOT, _SKELETON, _ANIMATION, _MESH, _MATERIAL = (
    "/Avatar",
    "/Avatar/Skeleton",
    "/Avatar/Skeleton/Animation",
    "/Avatar/Mesh",
    "/Avatar/Material",
)


@dataclass(frozen=True)
class _Joints:
    """The joints of a skin in USD's order, parents before children.

    Attributes:
        nodes: of the joints.
        parents: index in this order of each joint's parent; -1 for roots.
        skin_index: index in the skin of each joint.
    """

    nodes: list[int]
    parents: list[int]
    skin_index: list[int]


@dataclass(frozen=True)
class _Clip:
    """Local transforms of the skin's joints: times (s), translations (m), unit quaternions (glTF's order xyzw)."""

    time_s: Float[np.ndarray, "n"]
    translations_m: Float[np.ndarray, "n j 3"]
    rotations_xyzw: Float[np.ndarray, "n j 4"]


def write_usdz(path: Path, file: GlbFile) -> None:
    """Write an uncompressed package of a binary USD stage and its texture.

    Args:
        path: ends with .usdz.
        file: one skinned triangle list with one material.

    Raises:
        UserError: the file's arrays or images cannot be read.
        ModuleNotFoundError: the package usd-core is not installed.
    """
    from pxr import Sdf, Usd, UsdGeom, UsdSkel  # an optional package

    primitive = file.skinned_primitives()[0]
    with tempfile.TemporaryDirectory() as folder:
        stage_path = Path(folder) / "avatar.usdc"
        stage = Usd.Stage.CreateNew(str(stage_path))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        stage.SetTimeCodesPerSecond(TIME_CODES_PER_SECOND)
        root = UsdSkel.Root.Define(stage, _ROOT)
        Usd.ModelAPI(root.GetPrim()).SetKind("component")
        stage.SetDefaultPrim(root.GetPrim())
        joints = _ordered_joints(file, primitive.skin)
        _define_skeleton(stage, file, primitive.skin, joints)
        _define_mesh(stage, primitive, joints)
        _define_material(stage, file, primitive, Path(folder))
        extent = UsdGeom.Boundable.ComputeExtentFromPlugins(root, Usd.TimeCode(stage.GetStartTimeCode()))
        root.GetExtentAttr().Set(extent)
        stage.GetRootLayer().Save()
        with Sdf.ZipFileWriter.CreateNew(str(path)) as package:  # stored, aligned to 64 bytes; the root layer first
            for member in (stage_path, *sorted(Path(folder).glob("*.png"))):
                os.utime(member, (_MEMBER_TIME_S, _MEMBER_TIME_S))
                package.AddFile(str(member), member.name)


def _define_skeleton(stage: Any, file: GlbFile, skin: int, joints: _Joints) -> None:
    from pxr import Gf, Usd, UsdSkel, Vt

    names, matrices = _joint_paths(file, joints), file.accessor(file.gltf["skins"][skin]["inverseBindMatrices"])
    inverse_bind = matrices.reshape(-1, 4, 4).astype(np.float64)[joints.skin_index]
    bind = np.linalg.inv(inverse_bind)  # column-major in glTF is what USD's row vectors need
    rest = _joint_local_matrices(file, joints).transpose(0, 2, 1)
    skeleton = UsdSkel.Skeleton.Define(stage, _SKELETON)
    skeleton.CreateJointsAttr(names)
    skeleton.CreateBindTransformsAttr(Vt.Matrix4dArray.FromNumpy(np.ascontiguousarray(bind)))
    skeleton.CreateRestTransformsAttr(Vt.Matrix4dArray.FromNumpy(np.ascontiguousarray(rest)))
    if not file.gltf.get("animations"):
        return
    clip = _sample_clip(file, joints)
    animation = UsdSkel.Animation.Define(stage, _ANIMATION)
    animation.CreateJointsAttr(names)
    animation.CreateScalesAttr(Vt.Vec3hArray(len(names), Gf.Vec3h(1.0)))
    translations, rotations = animation.CreateTranslationsAttr(), animation.CreateRotationsAttr()
    for row, time_s in enumerate(clip.time_s.tolist()):
        code = Usd.TimeCode(time_s * TIME_CODES_PER_SECOND)
        translations.Set(Vt.Vec3fArray.FromNumpy(clip.translations_m[row].astype(np.float32)), code)
        quaternions = [Gf.Quatf(w, x, y, z) for x, y, z, w in clip.rotations_xyzw[row].tolist()]
        rotations.Set(Vt.QuatfArray(quaternions), code)
    stage.SetStartTimeCode(float(clip.time_s[0]) * TIME_CODES_PER_SECOND)
    stage.SetEndTimeCode(float(clip.time_s[-1]) * TIME_CODES_PER_SECOND)
    binding = UsdSkel.BindingAPI.Apply(skeleton.GetPrim())
    binding.CreateAnimationSourceRel().SetTargets([animation.GetPath()])


def _define_mesh(stage: Any, primitive: Primitive, joints: _Joints) -> None:
    from pxr import Gf, Sdf, UsdGeom, UsdSkel, Vt

    mesh = UsdGeom.Mesh.Define(stage, _MESH)
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(primitive.positions))
    mesh.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(mesh.GetPointsAttr().Get()))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray(len(primitive.faces), 3))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(primitive.faces.reshape(-1)))
    mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(primitive.normals))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    uv = np.stack([primitive.uv[:, 0], 1.0 - primitive.uv[:, 1]], axis=1)
    coordinates = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(
        "st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex
    )
    coordinates.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(uv, dtype=np.float32)))
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    influences, position_of = primitive.joints.shape[1], np.argsort(joints.skin_index)
    indices = Vt.IntArray.FromNumpy(position_of[primitive.joints].astype(np.int32).reshape(-1))
    binding.CreateJointIndicesPrimvar(constant=False, elementSize=influences).Set(indices)
    weights = Vt.FloatArray.FromNumpy(primitive.weights.astype(np.float32).reshape(-1))
    binding.CreateJointWeightsPrimvar(constant=False, elementSize=influences).Set(weights)
    binding.CreateGeomBindTransformAttr(Gf.Matrix4d(1.0))
    binding.CreateSkeletonRel().SetTargets([_SKELETON])


def _define_material(stage: Any, file: GlbFile, primitive: Primitive, folder: Path) -> None:
    """Add UsdPreviewSurface with the maps of the .glb; an unlit surface emits its base colour instead."""
    from pxr import Gf, Sdf, UsdShade

    surface = file.gltf["materials"][primitive.material]
    optics, extensions = surface["pbrMetallicRoughness"], surface.get("extensions", {})
    material = UsdShade.Material.Define(stage, _MATERIAL)
    shader = UsdShade.Shader.Define(stage, f"{_MATERIAL}/Surface")
    shader.CreateIdAttr("UsdPreviewSurface")
    material.CreateSurfaceOutput().ConnectToSource(shader.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    colours = _Map("Diffuse", _image_bytes(file, optics["baseColorTexture"]), "sRGB")
    if "KHR_materials_unlit" in extensions:
        shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(Gf.Vec3f(0.0))
        _connect(stage, shader, "emissiveColor", colours, folder)
    else:
        _connect(stage, shader, "diffuseColor", colours, folder)
        shader.CreateInput("useSpecularWorkflow", Sdf.ValueTypeNames.Int).Set(1)
        specular = extensions.get("KHR_materials_specular", {})
        factor = float(specular.get("specularFactor", 1.0))
        if "specularTexture" in specular:
            strength = Gf.Vec4f(*[DIELECTRIC_REFLECTANCE * factor] * 3, 1.0)
            grey = np.repeat(_image_pixels(file, specular["specularTexture"])[..., 3:], 3, axis=2)
            _connect(stage, shader, "specularColor", _Map("Specular", png_bytes(grey), "raw", strength), folder)
        else:
            grey_value = Gf.Vec3f(DIELECTRIC_REFLECTANCE * factor)
            shader.CreateInput("specularColor", Sdf.ValueTypeNames.Color3f).Set(grey_value)
        if "normalTexture" in surface:
            scale, bias = Gf.Vec4f(2.0, 2.0, 2.0, 1.0), Gf.Vec4f(-1.0, -1.0, -1.0, 0.0)
            normals = _Map("Normal", _image_bytes(file, surface["normalTexture"]), "raw", scale, bias)
            _connect(stage, shader, "normal", normals, folder)
    if "metallicRoughnessTexture" in optics:
        grey = np.repeat(_image_pixels(file, optics["metallicRoughnessTexture"])[..., 1:2], 3, axis=2)
        _connect(stage, shader, "roughness", _Map("Roughness", png_bytes(grey), "raw"), folder)
    else:
        shader.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(float(optics.get("roughnessFactor", 1.0)))
    shader.CreateInput("metallic", Sdf.ValueTypeNames.Float).Set(float(optics.get("metallicFactor", 1.0)))
    UsdShade.MaterialBindingAPI.Apply(stage.GetPrimAtPath(_MESH)).Bind(material)


@dataclass(frozen=True)
class _Map:
    """A texture: name of its shader and, in lower case, of its file; contents; colour space; value = scale x + bias."""

    name: str
    png: bytes
    colour_space: str
    scale: Any = None
    bias: Any = None


def _connect(stage: Any, shader: Any, input_name: str, texture: _Map, folder: Path) -> None:
    """Write the image of a map, and connect it to an input of the surface."""
    from pxr import Sdf, UsdShade

    image_name = f"{texture.name.lower()}.png"
    (folder / image_name).write_bytes(texture.png)
    reader = UsdShade.Shader.Define(stage, f"{_MATERIAL}/Coordinates")
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
    sampler = UsdShade.Shader.Define(stage, f"{_MATERIAL}/{texture.name}")
    sampler.CreateIdAttr("UsdUVTexture")
    sampler.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(image_name)
    sampler.CreateInput("sourceColorSpace", Sdf.ValueTypeNames.Token).Set(texture.colour_space)
    for wrap in ("wrapS", "wrapT"):
        sampler.CreateInput(wrap, Sdf.ValueTypeNames.Token).Set("clamp")
    for name, value in (("scale", texture.scale), ("bias", texture.bias)):
        if value is not None:
            sampler.CreateInput(name, Sdf.ValueTypeNames.Float4).Set(value)
    result = reader.CreateOutput("result", Sdf.ValueTypeNames.Float2)
    sampler.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(result)
    kinds = {"normal": Sdf.ValueTypeNames.Normal3f, "roughness": Sdf.ValueTypeNames.Float}
    is_scalar = input_name == "roughness"
    output_kind = Sdf.ValueTypeNames.Float if is_scalar else Sdf.ValueTypeNames.Float3
    output = sampler.CreateOutput("r" if is_scalar else "rgb", output_kind)
    shader.CreateInput(input_name, kinds.get(input_name, Sdf.ValueTypeNames.Color3f)).ConnectToSource(output)


def _image_bytes(file: GlbFile, texture: dict[str, Any]) -> bytes:
    return file.image_bytes(file.gltf["textures"][texture["index"]]["source"])


def _image_pixels(file: GlbFile, texture: dict[str, Any]) -> UInt8[np.ndarray, "h w c"]:
    return file.image_pixels(file.gltf["textures"][texture["index"]]["source"])


def _ordered_joints(file: GlbFile, skin: int) -> _Joints:
    skin_joints, nodes = file.gltf["skins"][skin]["joints"], file.gltf["nodes"]
    parent_of = {child: node for node in skin_joints for child in nodes[node].get("children", ())}

    def depth(node: int) -> int:
        return 1 + depth(parent_of[node]) if node in parent_of else 0

    ordered = sorted(skin_joints, key=depth)
    parents = [ordered.index(parent_of[node]) if node in parent_of else -1 for node in ordered]
    return _Joints(ordered, parents, [skin_joints.index(node) for node in ordered])


def _joint_paths(file: GlbFile, joints: _Joints) -> list[str]:
    """Return USD's names of the joints, for instance "Hips/Spine"."""
    from pxr import Tf

    paths: list[str] = []
    for node, parent in zip(joints.nodes, joints.parents, strict=True):
        name = Tf.MakeValidIdentifier(file.gltf["nodes"][node]["name"])
        paths.append(f"{paths[parent]}/{name}" if parent >= 0 else name)
    return paths


def _joint_local_matrices(file: GlbFile, joints: _Joints) -> Float[np.ndarray, "j 4 4"]:
    world = file.node_to_world()[joints.nodes]
    return np.stack([np.linalg.inv(world[p]) @ world[j] if p >= 0 else world[j] for j, p in enumerate(joints.parents)])


def _sample_clip(file: GlbFile, joints: _Joints) -> _Clip:
    """Sample the first animation at all its key times; joints without keys keep their rest transform."""
    animation, nodes = file.gltf["animations"][0], joints.nodes
    samplers = animation["samplers"]
    time_s = np.unique(np.concatenate([file.accessor(sampler["input"])[:, 0] for sampler in samplers]))
    rest = [file.gltf["nodes"][node] for node in nodes]
    translations_m = np.array([node.get("translation", [0.0] * 3) for node in rest]) + np.zeros((len(time_s), 1, 1))
    rotations = np.array([node.get("rotation", [0.0, 0.0, 0.0, 1.0]) for node in rest]) + np.zeros((len(time_s), 1, 1))
    tracks = {"translation": translations_m, "rotation": rotations}
    for channel in animation["channels"]:
        path, node = channel["target"]["path"], channel["target"]["node"]
        if path in tracks and node in nodes:
            sampler = samplers[channel["sampler"]]
            keys_s, values = file.accessor(sampler["input"])[:, 0], file.accessor(sampler["output"])
            for component in range(values.shape[1]):
                tracks[path][:, nodes.index(node), component] = np.interp(time_s, keys_s, values[:, component])
    return _Clip(time_s, translations_m, rotations / np.linalg.norm(rotations, axis=2, keepdims=True))
