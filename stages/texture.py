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
from pipeline.capture.usable_frames import training_positions
from pipeline.core.cli import main
from pipeline.core.errors import UserError
from pipeline.core.progress import track, warn
from pipeline.core.stage import Stage
from pipeline.field import setup as prepare
from pipeline.geometry.atlas import Atlas, Texels, rasterize_texels, texture_size_px, unwrap
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.skinning import dense_weights, linear_blend_skinning
from pipeline.geometry.surface import laplacian
from pipeline.io.image import to_uint8, write_gray, write_rgb
from pipeline.io.npz import load_npz, save_npz
from pipeline.texture.bake import BakeConfig, Fill, Surface, bake_diffuse, paint, validation_psnr_db
from pipeline.texture.body_parts import part_of_faces
from pipeline.texture.inpainting import spread, vertex_means
from pipeline.texture.specular import corner_texels, fit_specular, observe_vertices
from pipeline.texture.views import View, crop_view, footprint_m, weigh_by_resolution

SPECULAR_SMOOTHING = 8


class Config(BakeConfig):
    """Options of the texture stage."""

    smallest_px: int = Field(512, ge=64, le=8192, description="side of the texture at least, pixels, a power of two")
    largest_px: int = Field(2048, ge=64, le=8192, description="side of the texture at most, pixels, a power of two")
    texels_per_pixel: float = Field(
        1.5, gt=0.1, le=8.0, description="texels along the side of what one pixel of the capture sees on the person"
    )
    padding_px: int = Field(4, ge=1, le=64, description="gutter between charts, texels")
    max_frames: int = Field(100, ge=1, description="training frames used, evenly spread over the recording")
    specular_least_gain: float = Field(
        0.1,
        ge=0.0,
        le=1.0,
        description="share of the error on validation frames that highlights must explain, or matte",
    )

    @field_validator("smallest_px", "largest_px")
    @classmethod
    def _power_of_two(cls, side_px: int) -> int:
        if side_px.bit_count() != 1:
            raise ValueError("a power of two")
        return side_px

    @field_validator("largest_px")
    @classmethod
    def _not_below_smallest(cls, side_px: int, checked: ValidationInfo) -> int:
        smallest_px = checked.data.get("smallest_px", side_px)
        if side_px < smallest_px:
            raise ValueError(f"at least smallest_px, which is {smallest_px}")
        return side_px


@dataclass(frozen=True)
class SkinnedMesh:
    """The artifact of the mesh stage."""

    mesh: Mesh
    joint_indices: Int[np.ndarray, "v 4"]
    joint_weights: Float[np.ndarray, "v 4"]


def run(inputs: Mapping[str, Path], out: Path, config: Config) -> Mapping[str, float]:
    """Writes `atlas.npz`, `diffuse.png`, `specular.png` and `coverage.png`."""
    body, skinned = load_body(inputs["body"] / "body.npz"), load_mesh(inputs["mesh"])
    capture = load_capture(inputs["frames"])
    chosen = training_positions(capture, inputs["body"]), capture.positions(VALIDATION)
    train, validation = (
        load_views(capture, positions, inputs, body, skinned, config.max_frames) for positions in chosen
    )
    if not train:
        raise UserError(f"{inputs['frames']} has no training frames; run `python -m stages.frames` again")
    atlas, size_px = make_atlas(skinned, body, train, config)
    texels = rasterize_texels(atlas, size_px)
    surface = Surface.of(skinned.mesh.faces, atlas, texels)
    diffuse, seen = bake_diffuse(train, surface, spread_over(skinned.mesh, texels), config)
    amplitude, gain = bake_specular(train, validation, skinned.mesh, config)
    specular = paint(torch.from_numpy(texels.interpolate(skinned.mesh.faces, amplitude[:, None])), texels)[..., 0]
    save_npz(out / "atlas.npz", {"uv": atlas.uv, "faces_uv": atlas.faces_uv, "vertex_of_uv": atlas.vertex_of_uv})
    write_rgb(out / "diffuse.png", to_uint8(diffuse))
    write_gray(out / "specular.png", to_uint8(specular))
    write_gray(out / "coverage.png", to_uint8(texels.image(seen[:, None])[..., 0]))
    shown = to_uint8(diffuse).astype(np.float32) / 255.0
    return {
        "texture_px": float(size_px),
        "seen_share": float((seen > 0.5).mean()),
        "used_share": float(len(texels.face) / size_px**2),
        "validation_psnr_body_db": validation_psnr_db(shown, validation, surface),
        "specular_gain": gain,
    }


def load_mesh(folder: Path) -> SkinnedMesh:
    """Reads `mesh.npz`."""
    arrays = load_npz(folder / "mesh.npz")
    return SkinnedMesh(Mesh(arrays["vertices"], arrays["faces"]), arrays["joint_indices"], arrays["joint_weights"])


def load_views(
    capture: Capture,
    positions: Int[np.ndarray, "k"],
    inputs: Mapping[str, Path],
    body: Body,
    skinned: SkinnedMesh,
    max_frames: int,
) -> list[View]:
    """Crops of the frames at these positions, evenly thinned, each with the mesh in its pose."""
    camera = load_camera(inputs["body"] / "camera.npz")
    transforms = canonical_to_world(body, load_motion(inputs["field"] / "motion.npz"))
    vertices = torch.from_numpy(skinned.mesh.vertices)
    weights = dense_weights(
        torch.from_numpy(skinned.joint_indices), torch.from_numpy(skinned.joint_weights), len(body.joint_names)
    )
    faces = torch.from_numpy(skinned.mesh.faces)
    thinned = positions[prepare.spread(len(positions), max_frames)]
    views = []
    for k in track(thinned.tolist(), "reading frames"):
        posed = linear_blend_skinning(vertices, weights, transforms[k : k + 1])[0]
        image, mask = to_uint8(capture.image(k)), to_uint8(capture.mask(k))
        views.append(crop_view(image, mask, camera, posed, faces))
    return weigh_by_resolution(views) if views else []


def make_atlas(skinned: SkinnedMesh, body: Body, views: list[View], config: Config) -> tuple[Atlas, int]:
    """The atlas, and the side of its textures from what the capture can resolve."""
    finest_m = float(np.median([footprint_m(view) for view in views])) / config.texels_per_pixel
    area_m2 = float(skinned.mesh.face_areas_m2().sum())
    size_px = texture_size_px(area_m2, finest_m, config.smallest_px, config.largest_px)
    part = part_of_faces(skinned.mesh.faces, skinned.joint_indices, skinned.joint_weights, body.joint_names)
    return unwrap(skinned.mesh, part, size_px, config.padding_px), size_px


def spread_over(mesh: Mesh, texels: Texels) -> Fill:
    """Colours for what no frame shows, from what is seen around it on the mesh."""

    def fill(colour: Float[np.ndarray, "t 3"], seen: Float[np.ndarray, "t"]) -> Float[np.ndarray, "t 3"]:
        means, weights = vertex_means(texels, mesh.faces, len(mesh.vertices), colour, seen)
        return texels.interpolate(mesh.faces, spread(mesh, means, weights))

    return fill


def bake_specular(
    train: list[View], validation: list[View], mesh: Mesh, config: Config
) -> tuple[Float[np.ndarray, "v"], float]:
    """What highlights add to each vertex's colour, and the share of the validation error that they explain."""
    if not validation:
        warn("there are no validation frames to judge highlights on: the surface stays matte")
        return np.zeros(len(mesh.vertices), dtype=np.float32), 0.0
    count = len(mesh.vertices)
    texels = corner_texels(mesh.faces, count)
    faces = torch.from_numpy(mesh.faces)
    surface = Surface(faces, faces, torch.zeros(count, 2), texels)
    seen = [observe_vertices(views, surface, config) for views in (train, validation)]
    fitted = fit_specular(seen[0], seen[1], mesh.edges(), count, config.specular_least_gain)
    amplitude, operator = fitted.amplitude.astype(np.float64), laplacian(mesh)
    for _ in range(SPECULAR_SMOOTHING):
        amplitude = amplitude - 0.5 * (operator @ amplitude)
    return amplitude.astype(np.float32), fitted.gain


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
