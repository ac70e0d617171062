"""texture: an atlas of the mesh, and its diffuse and specular maps, baked from the video."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from pydantic import Field, ValidationInfo, field_validator

from pipeline.body.body import Body, canonical_to_world
from pipeline.body.files import load_body, load_camera, load_motion
from pipeline.capture.capture import Capture, load_capture
from pipeline.capture.frame_selection import VALIDATION
from pipeline.capture.usable_frames import usable_training_positions
from pipeline.core.cli import main
from pipeline.core.errors import UserError
from pipeline.core.progress import track, warn
from pipeline.core.stage import Stage
from pipeline.field import setup as prepare
from pipeline.geometry.atlas import Atlas, Texels, rasterize_texels, texture_size_px, unwrap
from pipeline.geometry.camera import pixel_footprint_m
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.skinning import dense_weights, linear_blend_skinning
from pipeline.geometry.surface import laplacian
from pipeline.io.image import to_uint8, write_gray, write_rgb
from pipeline.io.npz import load_npz, save_npz
from pipeline.texture.bake import (
    BakeConfig,
    InpaintFunction,
    TexturedSurface,
    bake_diffuse,
    mean_foreground_psnr_db,
    texels_to_texture,
)
from pipeline.texture.body_parts import body_part_of_faces
from pipeline.texture.inpainting import average_texels_per_vertex, spread
from pipeline.texture.specular import fit_specular, observe_vertices, texels_at_vertices
from pipeline.texture.views import BakeView, crop_bake_view, weight_by_resolution

SPECULAR_SMOOTHING_STEPS = 8


class Config(BakeConfig):
    """Options of the texture stage."""

    min_texture_px: int = Field(512, ge=64, le=8192, description="side of the texture at least, pixels, a power of two")
    max_texture_px: int = Field(2048, ge=64, le=8192, description="side of the texture at most, pixels, a power of two")
    texels_per_pixel: float = Field(
        1.5, gt=0.1, le=8.0, description="texels along the side of what one pixel of the capture sees on the person"
    )
    padding_px: int = Field(4, ge=1, le=64, description="gutter between charts, texels")
    max_frames: int = Field(100, ge=1, description="training frames used, evenly spread over the recording")
    specular_min_partial_r2: float = Field(
        0.1,
        ge=0.0,
        le=1.0,
        description="share of the error on validation frames that highlights must explain, or matte",
    )

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
            raise ValueError(f"at least smallest_px, which is {min_texture_px}")
        return side_px


@dataclass(frozen=True)
class SkinnedMeshArtifact:
    """The artifact of the mesh stage."""

    mesh: Mesh
    joint_indices: Int[np.ndarray, "v 4"]
    joint_weights: Float[np.ndarray, "v 4"]


def run(inputs: Mapping[str, Path], out: Path, config: Config) -> Mapping[str, float]:
    """Writes `atlas.npz`, `diffuse.png`, `specular.png` and `coverage.png`."""
    body, skinned = load_body(inputs["body"] / "body.npz"), load_mesh(inputs["mesh"])
    capture = load_capture(inputs["frames"])
    chosen = usable_training_positions(capture, inputs["body"]), capture.positions(VALIDATION)
    train, validation = (
        load_views(capture, positions, inputs, body, skinned, config.max_frames) for positions in chosen
    )
    if not train:
        raise UserError(f"{inputs['frames']} has no training frames; run `python -m stages.frames` again")
    atlas, size_px = build_atlas(skinned, body, train, config)
    texels = rasterize_texels(atlas, size_px)
    surface = TexturedSurface.from_arrays(skinned.mesh.faces, atlas, texels)
    diffuse, seen = bake_diffuse(train, surface, texel_inpainter(skinned.mesh, texels), config)
    amplitude, partial_r2 = bake_specular(train, validation, skinned.mesh, config)
    specular = texels_to_texture(torch.from_numpy(texels.interpolate(skinned.mesh.faces, amplitude[:, None])), texels)[
        ..., 0
    ]
    save_npz(out / "atlas.npz", {"uv": atlas.uv, "faces_uv": atlas.faces_uv, "vertex_of_uv": atlas.vertex_of_uv})
    write_rgb(out / "diffuse.png", to_uint8(diffuse))
    write_gray(out / "specular.png", to_uint8(specular))
    write_gray(out / "coverage.png", to_uint8(texels.to_texture(seen[:, None])[..., 0]))
    quantised_diffuse = to_uint8(diffuse).astype(np.float32) / 255.0
    return {
        "texture_px": float(size_px),
        "observed_texel_fraction": float((seen > 0.5).mean()),
        "atlas_utilisation": float(len(texels.face) / size_px**2),
        "validation_psnr_body_db": mean_foreground_psnr_db(quantised_diffuse, validation, surface),
        "specular_partial_r2": partial_r2,
    }


def load_mesh(folder: Path) -> SkinnedMeshArtifact:
    """Reads `mesh.npz`."""
    arrays = load_npz(folder / "mesh.npz")
    return SkinnedMeshArtifact(
        Mesh(arrays["vertices"], arrays["faces"]), arrays["joint_indices"], arrays["joint_weights"]
    )


def load_views(
    capture: Capture,
    positions: Int[np.ndarray, "k"],
    inputs: Mapping[str, Path],
    body: Body,
    skinned: SkinnedMeshArtifact,
    max_frames: int,
) -> list[BakeView]:
    """Crops of the frames at these positions, evenly thinned, each with the mesh in its pose."""
    camera = load_camera(inputs["body"] / "camera.npz")
    transforms = canonical_to_world(body, load_motion(inputs["field"] / "motion.npz"))
    vertices = torch.from_numpy(skinned.mesh.vertices)
    weights = dense_weights(
        torch.from_numpy(skinned.joint_indices), torch.from_numpy(skinned.joint_weights), len(body.joint_names)
    )
    faces = torch.from_numpy(skinned.mesh.faces)
    subsampled = positions[prepare.evenly_spaced(len(positions), max_frames)]
    views = []
    for k in track(subsampled.tolist(), "reading frames"):
        posed = linear_blend_skinning(vertices, weights, transforms[k : k + 1])[0]
        image, mask = to_uint8(capture.image(k)), to_uint8(capture.mask(k))
        views.append(crop_bake_view(image, mask, camera, posed, faces))
    return weight_by_resolution(views) if views else []


def build_atlas(skinned: SkinnedMeshArtifact, body: Body, views: list[BakeView], config: Config) -> tuple[Atlas, int]:
    """The atlas, and the side of its textures from what the capture can resolve."""
    texel_size_m = (
        float(np.median([pixel_footprint_m(view.vertices_world, view.camera) for view in views]))
        / config.texels_per_pixel
    )
    area_m2 = float(skinned.mesh.face_areas_m2().sum())
    size_px = texture_size_px(area_m2, texel_size_m, config.min_texture_px, config.max_texture_px)
    part = body_part_of_faces(skinned.mesh.faces, skinned.joint_indices, skinned.joint_weights, body.joint_names)
    return unwrap(skinned.mesh, part, size_px, config.padding_px), size_px


def texel_inpainter(mesh: Mesh, texels: Texels) -> InpaintFunction:
    """Colours for what no frame shows, from what is seen around it on the mesh."""

    def inpaint(colour: Float[np.ndarray, "t 3"], seen: Float[np.ndarray, "t"]) -> Float[np.ndarray, "t 3"]:
        means, weights = average_texels_per_vertex(texels, mesh.faces, len(mesh.vertices), colour, seen)
        return texels.interpolate(mesh.faces, spread(mesh, means, weights))

    return inpaint


def bake_specular(
    train: list[BakeView], validation: list[BakeView], mesh: Mesh, config: Config
) -> tuple[Float[np.ndarray, "v"], float]:
    """What highlights add to each vertex's colour, and the share of the validation error that they explain."""
    if not validation:
        warn("there are no validation frames to judge highlights on: the surface stays matte")
        return np.zeros(len(mesh.vertices), dtype=np.float32), 0.0
    count = len(mesh.vertices)
    texels = texels_at_vertices(mesh.faces, count)
    faces = torch.from_numpy(mesh.faces)
    surface = TexturedSurface(faces, faces, torch.zeros(count, 2), texels)
    seen = [observe_vertices(views, surface, config) for views in (train, validation)]
    fitted = fit_specular(seen[0], seen[1], mesh.edges(), count, config.specular_min_partial_r2)
    amplitude, operator = fitted.amplitude.astype(np.float64), laplacian(mesh)
    for _ in range(SPECULAR_SMOOTHING_STEPS):
        amplitude = amplitude - 0.5 * (operator @ amplitude)
    return amplitude.astype(np.float32), fitted.partial_r2


STAGE = Stage(
    "texture",
    version=3,
    needs=("frames", "body", "field", "mesh"),
    makes=("atlas.npz", "diffuse.png", "specular.png", "coverage.png"),
    config=Config,
    run=run,
)

if __name__ == "__main__":
    raise SystemExit(main(STAGE))
