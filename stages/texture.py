"""texture stage: unwrap the mesh into a UV atlas and bake diffuse, specular, normal and coverage maps."""

from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Float32, Int
from pydantic import Field, ValidationInfo, field_validator
from torch import Tensor

from pipeline.body.body import Body, canonical_to_world
from pipeline.body.files import load_body, load_camera, load_motion
from pipeline.capture.capture import Capture, load_capture
from pipeline.capture.face_detector import FaceDetector
from pipeline.capture.frame_selection import VALIDATION, evenly_spaced
from pipeline.capture.usable_frames import usable_positions
from pipeline.core.cli import main
from pipeline.core.command import rerun_command
from pipeline.core.config import Config as BaseConfig
from pipeline.core.errors import UserError
from pipeline.core.progress import track, warn
from pipeline.core.stage import Stage
from pipeline.geometry.atlas import Atlas, Texels, rasterize_texels, texture_size_px, unwrap
from pipeline.geometry.camera import Camera, pixel_footprint_m
from pipeline.geometry.creases import find_creases
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.skinning import linear_blend_skinning
from pipeline.io.image import to_float, to_uint8
from pipeline.kernels.common.thread_pool import shared_thread_pool
from pipeline.mesh.files import MeshArtifact, load_dense_mesh, load_mesh
from pipeline.template.correspondence import correspond
from pipeline.template.face.filmed_landmarks import FilmedFaces
from pipeline.template.face.head_texture import register_person
from pipeline.template.files import TEMPLATE_NPZ, FittedTemplate, save_template
from pipeline.template.hollow_skirt import find_lining
from pipeline.template.mirror import add_mirrored_colours, mirror_vertices
from pipeline.template.registration import Registration
from pipeline.template.template_atlas import TemplateAtlas, build_template_atlas
from pipeline.texture.bake import (
    InpaintFunction,
    TexturedSurface,
    bake_diffuse,
    mean_foreground_psnr_db,
)
from pipeline.texture.body_parts import body_part_of_faces
from pipeline.texture.contact import Limbs, hide_contacts
from pipeline.texture.files import (
    ATLAS,
    COVERAGE,
    DIFFUSE,
    LIGHT,
    NORMAL,
    ROUGHNESS,
    SPECULAR,
    TextureArtifact,
    TextureFormat,
    save_texture,
)
from pipeline.texture.hand_colours import hide_foreign_hands
from pipeline.texture.inpainting import average_texels_per_vertex, inpaint_vertex_colours
from pipeline.texture.light import VideoLight
from pipeline.texture.lighting.shading import find_light, fit_highlights, light_metrics, light_views
from pipeline.texture.normal_map import bake_normal_map
from pipeline.texture.settings import DEFAULT_SETTINGS, TextureSettings
from pipeline.texture.unseen_sides import BodySlices, add_unseen_colours, find_slice_colours
from pipeline.texture.vertex_texels import vertex_map, vertex_surface
from pipeline.texture.views import BakeView, crop_bake_view, weight_by_resolution

LANDMARKS_CHECKPOINT, TEXELS_CHECKPOINT = "checkpoint_landmarks.npz", "checkpoint_texels.safetensors"

NORMAL_MAP_DIVISOR, MIN_NORMAL_MAP_PX = 2, 64
"""Side of the normal map: half of that of the other maps. An edge of the dense mesh is two texels long or more."""


class Config(BaseConfig):
    """Options of the texture stage; see `TextureSettings` for what is fixed."""

    rounds: int = Field(3, ge=0, le=20, description="rounds of aligning the frames and adding their residuals")
    min_texture_px: int = Field(512, ge=64, le=8192, description="smallest side of the texture, px, a power of two")
    max_texture_px: int = Field(
        2048,
        ge=64,
        le=8192,
        description="largest side of the texture, px, a power of two",
    )
    format: TextureFormat = Field(
        "png8",
        description="files of the maps: png8, png16, or exr (8-bit .png and half floats in .exr)",
    )
    atlas: Literal["capture", "template"] = Field(
        "template",
        description="layout of the maps: template (the same for every person) or capture (charts of this person)",
    )
    light: Literal["auto", "removed", "kept"] = Field(
        "auto",
        description="light of the video in the diffuse map: removed, kept, or auto (decided on validation frames)",
    )
    normal_map: bool = Field(
        False, description="normal map of what the mesh lost when its faces were reduced; no closer to the person"
    )
    max_frames: int = Field(60, ge=1, description="largest number of training frames, evenly spaced over the recording")

    @field_validator("min_texture_px", "max_texture_px")
    @classmethod
    def _power_of_two(cls, side_px: int) -> int:
        if side_px.bit_count() != 1:
            raise ValueError("a power of two")
        return side_px

    @field_validator("max_texture_px")
    @classmethod
    def _at_least_minimum(cls, side_px: int, checked: ValidationInfo) -> int:
        min_texture_px = checked.data.get("min_texture_px", side_px)
        if side_px < min_texture_px:
            raise ValueError(f"at least min_texture_px, which is {min_texture_px}")
        return side_px


def run(
    inputs: Mapping[str, Path], out: Path, config: Config, settings: TextureSettings = DEFAULT_SETTINGS
) -> Mapping[str, float]:
    """Write the atlas and the maps into `out`; see `pipeline.texture.files`.

    settings: for sweeps and ablations from Python; the command uses the defaults.

    Raises:
        UserError: an input artifact cannot be read, or there are no training frames.
    """
    body, skinned = load_body(inputs["body"] / "body.npz"), load_mesh(inputs["mesh"])
    capture = load_capture(inputs["frames"])
    usable = usable_positions(capture, inputs["body"]), usable_positions(capture, inputs["body"], VALIDATION)
    positions = subsample(usable[0], config.max_frames), subsample(usable[1], config.max_frames)
    train, validation = (load_views(capture, part, inputs, body, skinned) for part in positions)
    if not train:
        raise UserError(f"{inputs['frames']} has no training frames; run {rerun_command('frames', inputs['frames'])}")

    faces = FilmedFaces.of_capture(capture, usable[0], *load_poses(inputs, body))
    registration = register_person(body, skinned, train, faces, FaceDetector, settings, out / LANDMARKS_CHECKPOINT)
    atlas, size_px, on_template = build_atlas(skinned, body, train, registration, config, settings)
    texels = rasterize_texels(atlas, size_px)
    face_count = len(skinned.mesh.faces)
    cut = None if on_template is None else on_template.cut
    if cut is not None:
        skinned = skinned.cut(cut)
        train, validation = ([view.cut(cut) for view in part] for part in (train, validation))
    template = None
    if registration is not None:
        template = FittedTemplate(registration, correspond(body, registration, skinned.mesh, skinned.vertex_colours))

    creases = find_creases(skinned.mesh)
    split, layout = skinned.split(creases), creases.split_atlas(atlas)
    mesh, limbs = split.mesh, Limbs.of_vertices(split.joint_indices, split.joint_weights, body.joint_names)
    train, validation = (
        [hide_contacts(view.split(creases), mesh.faces, limbs.limb) for view in part] for part in (train, validation)
    )
    train = hide_foreign_hands(train, vertex_surface(mesh), limbs, settings)
    evidence = None if config.light == "kept" else find_light((train, validation), positions, mesh, settings)
    light = VideoLight.uniform(len(capture))
    if evidence is not None:
        is_removed = evidence.helps or config.light == "removed"
        light = evidence.for_capture(positions[0], len(capture), is_removed=is_removed)
    highlights = fit_highlights(evidence, light, mesh)

    surface = TexturedSurface.from_arrays(mesh.faces, layout, texels)
    train, validation = (
        light_views(views, light, part, surface.faces, highlights)
        for views, part in zip((train, validation), positions, strict=True)
    )
    inpaint = make_texel_inpainter(skinned, body, texels, template)
    diffuse, texel_confidence = bake_diffuse(train, surface, inpaint, config.rounds, settings, out / TEXELS_CHECKPOINT)
    artifact = TextureArtifact(
        atlas,
        diffuse=diffuse,
        specular=vertex_map(highlights.strength, mesh, texels),
        coverage=to_uint8(texels.to_texture(texel_confidence[:, None])[..., 0]),
        light=light,
        highlights=highlights.highlights,
        normal=make_normal_map(inputs["mesh"], mesh, layout, size_px, face_count) if config.normal_map else None,
        cut=cut,
        roughness=None if highlights.roughness is None else vertex_map(highlights.roughness, mesh, texels),
    )
    save_texture(out, artifact, config.format)
    save_template(out, template)
    return {
        "texture_px": float(size_px),
        "observed_texel_fraction": float((texel_confidence > 0.5).mean()),
        "atlas_utilisation": float(len(texels.face) / size_px**2),
        **({} if on_template is None else {"atlas_own_charts_share": on_template.loose_share}),
        "validation_psnr_body_db": mean_foreground_psnr_db(to_float(to_uint8(diffuse)), validation, surface),
        **highlights.metrics(),
        **light_metrics(evidence, light),
        **template_metrics(template),
    }


def load_views(
    capture: Capture,
    positions: Int[np.ndarray, "k"],
    inputs: Mapping[str, Path],
    body: Body,
    skinned: MeshArtifact,
) -> list[BakeView]:
    """Crop frames to the mesh in the pose of each frame."""
    transforms, camera = load_poses(inputs, body)
    vertices, faces = torch.from_numpy(skinned.mesh.vertices), torch.from_numpy(skinned.mesh.faces)
    weights = skinned.dense_skin_weights(len(body.joint_names))

    def load_view(k: int) -> BakeView:
        posed = linear_blend_skinning(vertices, weights, transforms[k : k + 1])[0]
        return crop_bake_view(to_uint8(capture.image(k)), to_uint8(capture.mask(k)), camera, posed, faces)

    loaded = shared_thread_pool(torch.get_num_threads()).imap(load_view, positions.tolist())
    views = list(track(loaded, "reading frames", len(positions)))
    return weight_by_resolution(views) if views else []


def load_poses(inputs: Mapping[str, Path], body: Body) -> tuple[Float[Tensor, "n j 4 4"], Camera]:
    """Return the canonical-to-world transforms of the joints in all frames, and the camera."""
    motion = load_motion(inputs["mesh"] / "motion.npz")
    return canonical_to_world(body, motion), load_camera(inputs["body"] / "camera.npz")


def subsample(positions: Int[np.ndarray, "k"], max_frames: int) -> Int[np.ndarray, "m"]:
    """Return at most `max_frames` evenly spaced positions."""
    return positions[evenly_spaced(len(positions), max_frames)]


def template_metrics(template: FittedTemplate | None) -> dict[str, float]:
    """Return how well the template lies on the person, and the share of vertices of each label."""
    if template is None:
        return {}
    median_mm, p95_mm = template.registration.skin_distance_mm()
    return {
        "template_distance_median_mm": median_mm,
        "template_distance_p95_mm": p95_mm,
        "template_flipped_faces": float(template.registration.flipped_faces),
        "template_has_face": float(template.registration.has_face),
        **{f"{name}_share": share for name, share in template.correspondence.shares().items()},
    }


def build_atlas(
    skinned: MeshArtifact,
    body: Body,
    views: list[BakeView],
    registration: Registration | None,
    config: Config,
    settings: TextureSettings,
) -> tuple[Atlas, int, TemplateAtlas | None]:
    """Lay the mesh out, and choose the side of the textures (px) from the resolution of the capture.

    Returns:
        The atlas, the side, and what the atlas does to the mesh; None for a layout of the person's own.
    """
    footprints_m = [pixel_footprint_m(view.vertices_world, view.camera) for view in views]
    texel_size_m = float(np.median(footprints_m)) / settings.texels_per_pixel
    area_m2 = float(skinned.outside().face_areas_m2().sum())
    size_px = texture_size_px(area_m2, texel_size_m, config.min_texture_px, config.max_texture_px)
    if config.atlas == "template" and registration is None:
        warn("texture.atlas=template needs the built-in body, not one of a model file: the layout is the person's own")
    if config.atlas == "template" and registration is not None:
        layout = registration, size_px, settings.padding_px
        on_template = build_template_atlas(skinned.mesh, *layout, is_inside=skinned.is_inside)
        return on_template.atlas, size_px, on_template
    part = body_part_of_faces(skinned.mesh.faces, skinned.joint_indices, skinned.joint_weights, body.joint_names)
    return unwrap(skinned.mesh, part, size_px, settings.padding_px), size_px, None


def make_normal_map(
    mesh_dir: Path, mesh: Mesh, atlas: Atlas, texture_px: int, face_count: int
) -> Float32[np.ndarray, "n n 3"] | None:
    """Return the normal map of what the reduction of the faces removed; None if it removed none.

    face_count: of the mesh stage's mesh; `mesh` may be cut for the atlas.
    """
    dense = load_dense_mesh(mesh_dir)
    if len(dense.faces) == face_count:
        return None
    return bake_normal_map(mesh, atlas, dense, max(texture_px // NORMAL_MAP_DIVISOR, MIN_NORMAL_MAP_PX))


def make_texel_inpainter(
    skinned: MeshArtifact, body: Body, texels: Texels, template: FittedTemplate | None = None
) -> InpaintFunction:
    """Return a function that inpaints unobserved texels from observed colours.

    From those of the other side of the body where both sides agree, of the same slice of the body part far from
    everything that is observed, of the outer side for the lining of a skirt, and around them on the surface elsewhere.

    template: tells the other side of the body.
    """
    mesh, partner = skinned.mesh, None
    is_inside = np.zeros(len(mesh.vertices), dtype=bool) if skinned.is_inside is None else skinned.is_inside
    lining = find_lining(mesh, is_inside)
    slices = BodySlices.of_vertices(mesh.vertices, skinned.joint_indices, skinned.joint_weights, body)
    slices = slices.of_hollow_skirt(mesh.vertices[:, 1], is_inside, lining.hem_m(mesh.vertices))
    if template is not None:
        partner = mirror_vertices(template.correspondence, template.registration.vertices, mesh)

    def inpaint(colour: Float[np.ndarray, "t 3"], texel_confidence: Float[np.ndarray, "t"]) -> Float[np.ndarray, "t 3"]:
        means, weights = average_texels_per_vertex(texels, mesh.faces, len(mesh.vertices), colour, texel_confidence)
        found = find_slice_colours(mesh.vertices, slices, means, weights)
        means, weights = add_unseen_colours(found.vertices, found.colour, means, weights)
        means, weights = add_unseen_colours(lining.vertices, lining.of_outer_side(means), means, weights)
        before = weights
        if partner is not None:
            means, weights = add_mirrored_colours(mesh, partner, means, weights)
        taken = np.zeros(len(weights), dtype=bool)
        taken[found.vertices] = weights[found.vertices] == before[found.vertices]
        filled = texels.interpolate(mesh.faces, inpaint_vertex_colours(mesh, means, weights))
        return filled + found.between_vertices(mesh.faces, texels, taken)

    return inpaint


STAGE = Stage(
    "texture",
    version=22,
    needs=("frames", "body", "mesh"),
    makes=(ATLAS, DIFFUSE, SPECULAR, ROUGHNESS, NORMAL, COVERAGE, LIGHT, TEMPLATE_NPZ),
    config=Config,
    run=run,
)

if __name__ == "__main__":
    raise SystemExit(main(STAGE))
