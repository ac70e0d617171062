"""Load a finished run for evaluation: capture, fitted body, field and textured avatar, ready to render."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from pipeline.avatar.textured_avatar import TexturedAvatar
from pipeline.body.body import Body, Motion, canonical_to_world
from pipeline.body.files import load_body, load_camera, load_motion
from pipeline.capture.capture import Capture, load_capture
from pipeline.field.files import load_field, load_occupancy
from pipeline.field.rendering import render_field
from pipeline.field.skin_grid import build_skin_grid, skin_margin_m
from pipeline.geometry.atlas import Atlas
from pipeline.geometry.camera import Camera
from pipeline.geometry.creases import find_creases
from pipeline.geometry.texture_rendering import sample_texture
from pipeline.mesh.files import MeshArtifact, load_mesh
from pipeline.mesh.soles import LevelSoles
from pipeline.texture.files import TextureArtifact, load_texture
from pipeline.texture.light import VertexGloss

PoseRenderer = Callable[[Float[Tensor, "j 4 4"]], Float[np.ndarray, "h w 4"]]
"""Renders one pose (skinning matrices, canonical to world): premultiplied colours and alpha in [0, 1]."""


@dataclass(frozen=True)
class FinishedRun:
    """The artifacts of all stages up to texture.

    Attributes:
        motion: of every selected frame; training frames have the corrections of the field stage, the others were
            aligned to the outline of the mesh.
        field_renderer: renders the field with `camera`.
        refined_canonical_to_world: skinning matrices of `motion`.
        fitted_canonical_to_world: skinning matrices of the body stage's motion, for the mesh with level soles.
    """

    capture: Capture
    camera: Camera
    body: Body
    motion: Motion
    avatar: TexturedAvatar
    field_renderer: PoseRenderer
    refined_canonical_to_world: Float[Tensor, "n j 4 4"]
    fitted_canonical_to_world: Float[Tensor, "n j 4 4"]


def load_finished_run(inputs: Mapping[str, Path]) -> FinishedRun:
    """Read the artifacts of the frames, body, field, mesh and texture stages.

    inputs: artifact folder of each of these stages, by stage name.

    Raises:
        UserError: an artifact is missing or cannot be read.
    """
    body = load_body(inputs["body"] / "body.npz")
    camera = load_camera(inputs["body"] / "camera.npz")
    mesh, motion = load_mesh(inputs["mesh"]), load_motion(inputs["mesh"] / "motion.npz")
    fitted = mesh.soles.turn_motion_back(load_motion(inputs["body"] / "motion.npz"), body)
    return FinishedRun(
        capture=load_capture(inputs["frames"]),
        camera=camera,
        body=body,
        motion=motion,
        avatar=add_texture(mesh, load_texture(inputs["texture"])),
        field_renderer=_make_field_renderer(inputs["field"], mesh.soles, body, camera),
        refined_canonical_to_world=canonical_to_world(body, motion),
        fitted_canonical_to_world=canonical_to_world(body, fitted),
    )


def load_textured_avatar(mesh_dir: Path, texture_dir: Path) -> TexturedAvatar:
    """Read the skinned mesh of the mesh stage with the atlas and diffuse map of the texture stage."""
    return add_texture(load_mesh(mesh_dir), load_texture(texture_dir))


def add_texture(mesh: MeshArtifact, texture: TextureArtifact) -> TexturedAvatar:
    """Combine a skinned mesh with its atlas and maps."""
    whole = mesh.cut(texture.cut)
    creases = find_creases(whole.mesh)
    skinned, atlas = whole.split(creases), creases.split_atlas(texture.atlas)
    return TexturedAvatar(
        vertices=torch.from_numpy(skinned.mesh.vertices.astype(np.float32)),
        faces=torch.from_numpy(skinned.mesh.faces.astype(np.int32)),
        joint_indices=torch.from_numpy(skinned.joint_indices.astype(np.int64)),
        joint_weights=torch.from_numpy(skinned.joint_weights.astype(np.float32)),
        uv=torch.from_numpy(atlas.uv.astype(np.float32)),
        faces_uv=torch.from_numpy(atlas.faces_uv.astype(np.int32)),
        diffuse=torch.from_numpy(texture.diffuse),
        light=texture.light,
        gloss=vertex_gloss(replace(texture, atlas=atlas), len(skinned.mesh.vertices)),
        normal_map=texture.normal,
        skinned=skinned,
    )


def vertex_gloss(texture: TextureArtifact, vertex_count: int) -> VertexGloss | None:
    """Return the highlights of the vertices of a textured mesh; None for a matte surface."""
    if not texture.specular.any():
        return None
    maps = (texture.specular, texture.roughness)
    strength, roughness = (None if each is None else vertex_values(each, texture.atlas, vertex_count) for each in maps)
    return None if strength is None else VertexGloss(texture.highlights, strength, roughness)


def vertex_values(texture: Float32[np.ndarray, "th tw"], atlas: Atlas, vertex_count: int) -> Float[Tensor, "v"]:
    """Sample a map with one channel at the vertices: the mean over the corners of a vertex along UV seams."""
    values = sample_texture(torch.from_numpy(texture)[..., None], torch.from_numpy(atlas.uv))[:, 0]
    total = torch.zeros(vertex_count).index_add_(0, torch.from_numpy(atlas.vertex_of_uv).long(), values)
    return total / torch.from_numpy(np.maximum(np.bincount(atlas.vertex_of_uv, minlength=vertex_count), 1)).float()


def _make_field_renderer(field_dir: Path, soles: LevelSoles, body: Body, camera: Camera) -> PoseRenderer:
    """Return a renderer of the field in poses of the mesh, whose soles were turned."""
    field = load_field(field_dir / "field.safetensors")
    occupancy = load_occupancy(field_dir / "occupancy.npz")
    skin = build_skin_grid(body, skin_margin_m(body, occupancy.bounds_m.numpy()))
    to_mesh = soles.transforms(body)

    def render_pose(canonical_to_world: Float[Tensor, "j 4 4"]) -> Float[np.ndarray, "h w 4"]:
        return render_field(field, occupancy, body, canonical_to_world @ to_mesh, camera, skin).numpy()

    return render_pose
