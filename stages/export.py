"""export stage: write the avatar as a skinned, animated .glb and as a textured .obj."""

import shutil
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from pydantic import Field, field_validator

from pipeline.avatar.formats.vrm import VrmMeta
from pipeline.avatar.formats.vrm_springs import LooseParts
from pipeline.avatar.formats.write import ExportFormat, FormatRequest, missing_package, write_formats
from pipeline.avatar.gltf import MorphTargets, SkinnedMesh, encode_glb
from pipeline.avatar.gltf_material import MaterialMaps, encode_gloss
from pipeline.avatar.motion.idle import idle_motion
from pipeline.avatar.obj import ObjMaps, write_faces_obj, write_obj
from pipeline.avatar.placement import (
    pad_motion_to_video,
    translate_camera,
    translate_motion,
    world_to_scene_translation_m,
)
from pipeline.avatar.rig import RestPose, Rig, build_rig
from pipeline.avatar.rig_names import RigName
from pipeline.avatar.skinned_avatar import (
    a_pose_floor_y_m,
    build_skinned_mesh,
    lowest_vertex_y_m,
    stand_on_soles,
    to_rest_pose,
)
from pipeline.body.body import Body, Motion
from pipeline.body.files import load_body, load_camera, load_motion
from pipeline.capture.capture import load_capture
from pipeline.core.cli import main
from pipeline.core.config import Config as BaseConfig
from pipeline.core.errors import UserError
from pipeline.core.progress import warn
from pipeline.core.stage import Stage
from pipeline.geometry.atlas import Atlas
from pipeline.geometry.camera import Camera
from pipeline.geometry.creases import Creases, find_creases
from pipeline.geometry.mesh import Mesh
from pipeline.io.image import png_bytes, to_uint8, write_gray, write_rgb
from pipeline.mesh.files import MeshArtifact, load_mesh
from pipeline.template.face.animated_face import AnimatedFace, build_animated_face, eye_centres_m
from pipeline.template.face.patch import FacePatchError
from pipeline.template.face.texture import CapturedSurface
from pipeline.template.files import FittedTemplate, load_fitted_template
from pipeline.template.loose_parts import body_colliders, find_loose_parts
from pipeline.template.reshape import SHAPE_KEY_STEP, SHAPE_KEYS, carry_to_surface, shape_change
from pipeline.template.wrapped import WrappedTemplate, wrap_template
from pipeline.texture.files import DIFFUSE, NORMAL, ROUGHNESS, SPECULAR, TextureArtifact, load_texture, map_files
from pipeline.texture.light import TERMS, VideoLight
from pipeline.texture.normal_map import widen_flat

OBJ_MAPS = tuple(f"avatar_{name}" for name in (DIFFUSE, SPECULAR, ROUGHNESS, NORMAL))


class Config(BaseConfig):
    """Options of the export stage."""

    roughness: float = Field(
        0.85,
        ge=0.0,
        le=1.0,
        description="glTF roughness if the video shows no highlights: 0 (mirror) to 1 (matte)",
    )
    unlit: bool = Field(
        False,
        description="mark the .glb's material as unlit: viewers show the diffuse map without lights or highlights",
    )
    rig: RigName = Field(
        "plain",
        description="names and axes of the joints, those of clips that play by name: mixamo, unity (Humanoid), unreal, "
        "vrm; plain: as mixamo without the prefix mixamorig:, as in Ready Player Me",
    )
    rest_pose: RestPose = Field("a", description="pose of the .glb without animation, and of the .obj: a or t (T-pose)")
    face: bool = Field(
        True,
        description="the .glb's face moves: 52 morph targets of ARKit and 15 visemes, lids, lips, eyes, teeth, tongue",
    )
    shape_keys: bool = Field(
        False, description="the .glb has morph targets height, weight, muscle and age of the body, +0.2 at weight 1"
    )
    topology: Literal["adaptive", "template"] = Field(
        "adaptive",
        description="template: also write the built-in body's quads wrapped on the person: wrapped.obj, wrapped.glb",
    )
    licence_note: str = Field(
        "Made from a video of a person: ask that person before you share it.",
        description="text written to the .glb as asset.extras.licence_note",
    )
    formats: tuple[ExportFormat, ...] = Field(
        (),
        description="further files: vrm (VRM 1.0), vrm0 (VRM 0.x), lod (levels of detail), usdz, web (compressed .glb)",
    )
    author: str = Field("unknown", min_length=1, description="author in the .vrm files")
    licence_url: str = Field(
        "", description="address of the licence in the .vrm files; without it only the author may use them"
    )

    @field_validator("formats", mode="before")
    @classmethod
    def _split_names(cls, formats: object) -> object:
        return formats.replace(" ", "").split(",") if isinstance(formats, str) else formats

    @field_validator("formats")
    @classmethod
    def _check_packages(cls, formats: tuple[ExportFormat, ...]) -> tuple[ExportFormat, ...]:
        missing = missing_package(formats)
        if missing:
            raise ValueError(missing)
        return formats


@dataclass(frozen=True)
class Scene:
    """What the exported files show.

    Attributes:
        body: in the A-pose.
        skinned: the mesh in the A-pose, cut for the atlas.
        rig: names, axes and rest pose of the joints; there the lowest vertex is at y = 0.
        texture: atlas and maps.
        template: on the person; None for a body of a model file.
        motion: of the video, on a floor at y = 0, with the duration of the video.
        fps: frame rate of the video.
        camera: of the capture, in the same scene.
        extras: contents of `asset.extras`.
        face: the avatar with a face that moves; None without one.
    """

    body: Body
    skinned: MeshArtifact
    rig: Rig
    texture: TextureArtifact
    template: FittedTemplate | None
    motion: Motion
    fps: float
    camera: Camera
    extras: dict[str, Any]
    face: AnimatedFace | None = None

    def clips(self) -> dict[str, Motion]:
        """Return the animations of every .glb, by name."""
        return {"capture": self.motion, "idle": idle_motion(self.body, self.floor_y_m)}

    @property
    def floor_y_m(self) -> float:
        """See `a_pose_floor_y_m`: for motions made from those of joints."""
        return a_pose_floor_y_m(self.skinned)


def run(inputs: Mapping[str, Path], out: Path, config: Config) -> Mapping[str, float]:
    """Write `avatar.glb`, `avatar.obj` with its `.mtl` and maps, and the files of `config.formats`.

    Raises:
        UserError: an input artifact cannot be read.
    """
    scene = load_scene(inputs, config)
    glb = encode_scene(scene, config, scene.clips())
    (out / "avatar.glb").write_bytes(glb)
    meta = VrmMeta("avatar", config.author, config.licence_url)
    loose = loose_parts(scene) if {"vrm", "vrm0"} & set(config.formats) else LooseParts()
    write_formats(out / "avatar.glb", FormatRequest(config.formats, scene.body.joint_names, meta, loose))
    write_scene_obj(inputs["texture"], out, scene.texture, to_rest_pose(scene.skinned, scene.rig))
    if config.topology == "template":
        write_wrapped(scene, config, out)
    face = scene.face
    return {
        "glb_bytes": float(len(glb)),
        "texture_px": float(len(scene.texture.diffuse)),
        "animation_s": float(scene.motion.time_s[-1]),
        "vertices": float(len(scene.texture.atlas.uv)),
        "faces": float(len(scene.skinned.mesh.faces)),
        "glb_faces": float(len((face.atlas if face else scene.texture.atlas).faces_uv)),
        **({"spring_chains": float(len(loose.chains()))} if loose.parts else {}),
        "morph_targets": float(len(face.names)) if face else 0.0,
    }


def load_scene(inputs: Mapping[str, Path], config: Config) -> Scene:
    """Read the artifacts of the stages in `STAGE.needs`, and place person and camera on the floor.

    Raises:
        UserError: an input artifact cannot be read.
    """
    body, texture = load_body(inputs["body"] / "body.npz"), load_texture(inputs["texture"])
    skinned, template = load_mesh(inputs["mesh"]).cut(texture.cut), load_fitted_template(inputs["texture"])
    capture, motion = load_capture(inputs["frames"]), load_motion(inputs["mesh"] / "motion.npz")
    offset_m = world_to_scene_translation_m(motion, lowest_vertex_y_m(skinned, body, motion))
    return Scene(
        body=body,
        skinned=skinned,
        rig=stand_on_soles(build_rig(body, config.rig, config.rest_pose), skinned),
        texture=texture,
        template=template,
        motion=pad_motion_to_video(translate_motion(motion, offset_m), capture.fps, capture.n_video_frames),
        fps=capture.fps,
        camera=translate_camera(load_camera(inputs["body"] / "camera.npz"), offset_m),
        extras=asset_extras(config, offset_m, capture.fps) | light_extras(texture.light),
        face=make_face(body, template, skinned, texture) if config.face else None,
    )


def make_face(
    body: Body, template: FittedTemplate | None, skinned: MeshArtifact, texture: TextureArtifact
) -> AnimatedFace | None:
    """Return the avatar with a face that moves; None, with a warning, where the face is not found or not cut out."""
    captured = CapturedSurface(skinned.mesh, texture.atlas, texture.diffuse, texture.specular, texture.roughness)
    try:
        return build_animated_face(body, template.registration if template else None, skinned, captured)
    except FacePatchError as error:
        warn(f"the avatar's face does not move: {error}")
        return None


def loose_parts(scene: Scene) -> LooseParts:
    """Return skirts and long hair, with chains and weights for the .glb in its rest pose."""
    skinned, atlas = (scene.face.skinned, scene.face.atlas) if scene.face else (scene.skinned, scene.texture.atlas)
    creases = find_creases(skinned.mesh)
    source = creases.source[creases.split_atlas(atlas).vertex_of_uv]
    to_rest = dict(zip(scene.body.joint_names, scene.rig.bind_to_rest, strict=True))
    parts = []
    for part in find_loose_parts(scene.body, skinned):
        chains = tuple(
            replace(chain, joints_m=chain.joints_m @ to_rest[chain.parent][:3, :3].T + to_rest[chain.parent][:3, 3])
            for chain in part.chains
        )
        parts.append(replace(part, chains=chains, weights=part.weights[source]))
    return LooseParts(tuple(parts), tuple(body_colliders(scene.body)) if parts else ())


def encode_scene(scene: Scene, config: Config, clips: Mapping[str, Motion]) -> bytes:
    """Return the .glb with the clips as animations."""
    texture, face = scene.texture, scene.face
    atlas, normal = face.atlas if face else texture.atlas, texture.normal
    if face is not None and normal is not None:
        normal = widen_flat(normal)
    maps = material_maps(texture, config, face or texture, normal)
    skinned = face.skinned if face else scene.skinned
    creases = find_creases(skinned.mesh)
    at_rest, atlas = to_rest_pose(skinned.split(creases), scene.rig), creases.split_atlas(atlas)
    mesh = build_skinned_mesh(at_rest, atlas)
    if face is not None:
        source = creases.source[atlas.vertex_of_uv]
        displacements_m, turns = face.displacements_m[:, source], face.normal_changes[:, source]
        eyes_m = eye_centres_m(at_rest.mesh.vertices, face.eyeballs)
        mesh = replace(mesh, morphs=MorphTargets(face.names, displacements_m, eyes_m, turns))
    if config.shape_keys:
        mesh = add_shape_keys(mesh, scene, atlas, creases)
    return encode_glb(mesh, scene.rig, clips, maps, scene.camera, scene.extras)


def add_shape_keys(mesh: SkinnedMesh, scene: Scene, atlas: Atlas, creases: Creases) -> SkinnedMesh:
    """Return the mesh with a morph target for each of `SHAPE_KEYS`, after those of the face.

    atlas: of the mesh with the copies of `creases`.

    Raises:
        UserError: the body of the run is not the built-in one.
    """
    if scene.template is None:
        raise UserError("export.shape_keys=true needs the built-in body, and this run has a body of a model file")
    skinned = scene.face.skinned if scene.face else scene.skinned
    registration, at_rest = scene.template.registration, to_rest_pose(skinned.split(creases), scene.rig)
    moved, turned = [], []
    for name in SHAPE_KEYS:
        change = shape_change(scene.body, {name: SHAPE_KEY_STEP})
        vertices = (skinned.mesh.vertices + carry_to_surface(change, registration, skinned.mesh)).astype(np.float32)
        new = to_rest_pose(replace(skinned, mesh=Mesh(vertices, skinned.mesh.faces)).split(creases), scene.rig)
        moved.append((new.mesh.vertices - at_rest.mesh.vertices)[atlas.vertex_of_uv])
        turned.append((new.vertex_normals() - at_rest.vertex_normals())[atlas.vertex_of_uv])
    keys, turns = np.stack(moved).astype(np.float32), np.stack(turned).astype(np.float32)
    old = mesh.morphs
    if old is None:
        return replace(mesh, morphs=MorphTargets(SHAPE_KEYS, keys, None, turns))
    displacements_m = np.concatenate([old.displacements_m, keys])
    both_turn = None if old.normal_changes is None else np.concatenate([old.normal_changes, turns])
    return replace(mesh, morphs=MorphTargets((*old.names, *SHAPE_KEYS), displacements_m, old.eyes_m, both_turn))


def write_wrapped(scene: Scene, config: Config, out: Path) -> None:
    """Write `wrapped.obj` (quads) with its maps, and `wrapped.glb` (their halves): the template on the person.

    Raises:
        UserError: the body of the run is not the built-in one.
    """
    if scene.template is None:
        raise UserError("export.topology=template needs the built-in body, and this run has a body of a model file")
    texture = scene.texture
    captured = CapturedSurface(scene.skinned.mesh, texture.atlas, texture.diffuse, texture.specular, texture.roughness)
    wrapped = wrap_template(scene.body, scene.template.registration, captured)
    rig = stand_on_soles(scene.rig, wrapped.skinned)
    at_rest = to_rest_pose(wrapped.skinned, rig)
    vertices = at_rest.mesh.vertices
    mesh = build_skinned_mesh(at_rest, wrapped.atlas)
    if wrapped.names:
        eyes_m = eye_centres_m(vertices, wrapped.eyeballs)
        moved_m = wrapped.displacements_m[:, wrapped.atlas.vertex_of_uv]
        mesh = replace(mesh, morphs=MorphTargets(wrapped.names, moved_m, eyes_m))
    maps = material_maps(texture, config, wrapped)
    (out / "wrapped.glb").write_bytes(encode_glb(mesh, rig, scene.clips(), maps, scene.camera, scene.extras))
    write_rgb(out / f"wrapped_{DIFFUSE}", to_uint8(wrapped.diffuse))
    names = ObjMaps(f"wrapped_{DIFFUSE}", exponent=texture.highlights.exponent)
    if wrapped.specular.any():
        names = replace(names, specular=f"wrapped_{SPECULAR}")
        write_gray(out / f"wrapped_{SPECULAR}", to_uint8(wrapped.specular))
    if wrapped.roughness is not None:
        names = replace(names, roughness=f"wrapped_{ROUGHNESS}")
        write_gray(out / f"wrapped_{ROUGHNESS}", to_uint8(wrapped.roughness))
    surface, layout = (vertices, wrapped.quads), (wrapped.atlas.uv, wrapped.quads_uv)
    write_faces_obj(out / "wrapped.obj", surface, layout, at_rest.mesh.vertex_normals(), names)


def material_maps(
    texture: TextureArtifact,
    config: Config,
    shown: TextureArtifact | AnimatedFace | WrappedTemplate,
    normal: Float[np.ndarray, "n m 3"] | None = None,
) -> MaterialMaps:
    """Return the encoded maps of `shown`; `texture` has the lobe and the lamp of the highlights."""
    specular_png, roughness, roughness_png = encode_gloss(texture, shown.specular, shown.roughness, config.roughness)
    normal_png = None if normal is None else png_bytes(to_uint8(normal))
    diffuse_png = png_bytes(to_uint8(shown.diffuse))
    return MaterialMaps(diffuse_png, specular_png, roughness, config.unlit, normal_png, roughness_png)


def write_scene_obj(texture_dir: Path, out: Path, texture: TextureArtifact, skinned: MeshArtifact) -> None:
    """Write `avatar.obj`, `avatar.mtl` and the maps for the mesh in any pose."""
    names = {name: copy_map(texture_dir, name, out) for name in (DIFFUSE, SPECULAR, ROUGHNESS, NORMAL)}
    maps = ObjMaps(
        names[DIFFUSE],
        specular=names[SPECULAR] if texture.specular.any() else None,
        normal=None if texture.normal is None else names[NORMAL],
        roughness=None if texture.roughness is None else names[ROUGHNESS],
        exponent=texture.highlights.exponent,
    )
    layout, creases = texture.atlas, find_creases(skinned.mesh)
    normals = skinned.split(creases).vertex_normals()
    write_obj(out / "avatar.obj", skinned.mesh, layout.uv, layout.faces_uv, normals, maps, creases.faces)


def copy_map(texture_dir: Path, name: str, out: Path) -> str:
    """Copy the files of a map for the .obj; return the name of the one with the highest precision.

    The .glb embeds 8 bits: glTF allows 16-bit PNG, but no GPU has a 16-bit sRGB format, so viewers reduce it.
    """
    paths = map_files(texture_dir, name)
    for path in paths:
        shutil.copyfile(path, out / f"avatar_{path.name}")
    return f"avatar_{paths[-1].name}"


def asset_extras(config: Config, offset_m: Float[np.ndarray, "3"], frame_rate_hz: float) -> dict[str, Any]:
    """Return the contents of `asset.extras`: units, axes, offset of the scene, source and licence note."""
    return {
        "unit": "metre",
        "axes": "+Y up, the rest pose faces +Z",
        "world_to_scene_translation_m": [float(value) for value in offset_m],
        "world": "+Y up; of the supplied camera or SMPL poses, else estimated from the video, with the floor at y = 0",
        "frame_rate_hz": frame_rate_hz,
        "source": "reconstructed from one video",
        "licence_note": config.licence_note,
    }


def light_extras(light: VideoLight) -> dict[str, Any]:
    """Return `video_light` of `asset.extras`: the light that was removed from the diffuse map; nothing if none was.

    Irradiance by the unit normal (x, y, z) of the scene, linear RGB; 1 shows the base colour as it is.
    """
    if light.is_uniform:
        return {}
    return {
        "video_light": {
            "terms": list(TERMS),
            "coefficients": [[float(value) for value in row] for row in light.coefficients],
            "key_direction": [float(value) for value in light.key_direction],
            "key_irradiance": [float(value) for value in light.key_irradiance],
        }
    }


STAGE = Stage(
    "export",
    version=20,
    needs=("frames", "body", "mesh", "texture"),
    makes=("avatar.glb", "avatar.obj", "avatar.mtl", *OBJ_MAPS),
    config=Config,
    run=run,
    shows="avatar.glb",
)

if __name__ == "__main__":
    raise SystemExit(main(STAGE))
