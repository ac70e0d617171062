"""The artifact of the texture stage: the UV atlas as npz, the maps as images. One writer, one reader."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float32, UInt8

from pipeline.core.command import rerun_command
from pipeline.core.errors import UserError
from pipeline.geometry.atlas import Atlas
from pipeline.geometry.surface_cut import SurfaceCut
from pipeline.io.image import read_gray, read_rgb_float, to_uint8, to_uint16, write_gray, write_rgb
from pipeline.io.npz import load_npz, save_npz
from pipeline.texture.light import Highlights, VideoLight, load_light, save_light

ATLAS, DIFFUSE, SPECULAR, COVERAGE = "atlas.npz", "diffuse.png", "specular.png", "coverage.png"
LIGHT, NORMAL, ROUGHNESS = "light.npz", "normal.png", "roughness.png"
FLAT_NORMAL = (0.5, 0.5, 1.0)
"""Texel of a normal map that leaves the normal of the mesh as it is; 0.3 degrees off as (128, 128, 255) in 8 bits."""

TextureFormat = Literal["png8", "png16", "exr"]


@dataclass(frozen=True)
class TextureArtifact:
    """The atlas and its maps; row 0 of a map is v = 1.

    Attributes:
        atlas: UV layout of the mesh.
        diffuse: sRGB in [0, 1], gutters filled.
        specular: linear radiance that a highlight adds at its peak, in [0, 1]; all 0 for a matte surface.
        coverage: confidence that the video shows the texel, 0 to 255; 0 outside the charts.
        light: of the video. Uniform: the diffuse map holds the light; else it is the albedo.
        highlights: the lamp of the specular map, and the lobe where there is no roughness map.
        normal: tangent-space normals, from -1 to 1 as values in [0, 1] (`pipeline.texture.normal_map`); None for a
            surface without a normal map. Its side may be another than that of the other maps.
        cut: how the triangles of the mesh stage are split for the atlas, where it has the template's layout; None for
            an atlas of the person's own.
        roughness: glTF's, in (0, 1], of the lobe of each texel; None where it is that of `highlights` everywhere.
    """

    atlas: Atlas
    diffuse: Float32[np.ndarray, "s s 3"]
    specular: Float32[np.ndarray, "s s"]
    coverage: UInt8[np.ndarray, "s s"]
    light: VideoLight
    highlights: Highlights
    normal: Float32[np.ndarray, "n n 3"] | None = None
    cut: SurfaceCut | None = None
    roughness: Float32[np.ndarray, "s s"] | None = None


def save_texture(folder: Path, texture: TextureArtifact, texture_format: TextureFormat = "png8") -> None:
    """Write the atlas and the maps into `folder`; `load_texture` is the inverse up to the precision of the format."""
    atlas, cut = texture.atlas, texture.cut
    arrays = {"uv": atlas.uv, "faces_uv": atlas.faces_uv, "vertex_of_uv": atlas.vertex_of_uv}
    if cut is not None:
        arrays |= {
            "cut_corners": cut.corners.astype(np.int32),
            "cut_weights": cut.weights.astype(np.float32),
            "cut_faces": cut.faces.astype(np.int32),
        }
    save_npz(folder / ATLAS, arrays)
    save_maps(folder, texture, texture_format)
    write_gray(folder / COVERAGE, texture.coverage)
    save_light(folder / LIGHT, texture.light, texture.highlights)


def save_maps(folder: Path, texture: TextureArtifact, texture_format: TextureFormat = "png8") -> None:
    """Write the diffuse, specular, normal and roughness maps.

    Maps are PNG with 8 bits per channel, or 16 for "png16". "exr" adds OpenEXR files with linear half floats; its
    normal and roughness maps, whose values are no colours, are PNG with 16 bits. Without a normal map, that file is one
    flat texel; without a roughness map, one texel of the roughness of the lobe.
    """
    for name, values in ((DIFFUSE, texture.diffuse), (SPECULAR, texture.specular)):
        write = write_rgb if values.ndim == 3 else write_gray
        write(folder / name, to_uint16(values) if texture_format == "png16" else to_uint8(values))
        if texture_format == "exr":
            write((folder / name).with_suffix(".exr"), values)
    save_normal_map(folder / NORMAL, texture, texture_format)
    save_roughness_map(folder / ROUGHNESS, texture, texture_format)


def save_normal_map(path: Path, texture: TextureArtifact, texture_format: TextureFormat = "png8") -> None:
    """Write the normal map; without one, a single flat texel."""
    normal = np.full((1, 1, 3), FLAT_NORMAL, dtype=np.float32) if texture.normal is None else texture.normal
    write_rgb(path, to_uint8(normal) if texture_format == "png8" else to_uint16(normal))


def save_roughness_map(path: Path, texture: TextureArtifact, texture_format: TextureFormat = "png8") -> None:
    """Write the roughness map; without one, a single texel."""
    one = np.full((1, 1), texture.highlights.roughness, dtype=np.float32)
    roughness = one if texture.roughness is None else texture.roughness
    write_gray(path, to_uint8(roughness) if texture_format == "png8" else to_uint16(roughness))


def map_files(folder: Path, name: str) -> list[Path]:
    """Return the files of a map, the most precise last: `DIFFUSE` and `SPECULAR` may have an OpenEXR file."""
    exr = (folder / name).with_suffix(".exr")
    return [folder / name, *([exr] if exr.is_file() else [])]


def load_texture(folder: Path) -> TextureArtifact:
    """Read the artifact, maps in their highest precision.

    Raises:
        UserError: a file is missing or unreadable, or the atlas lacks an array.
    """
    arrays = load_npz(folder / ATLAS)
    try:
        atlas, cut = Atlas(arrays["uv"], arrays["faces_uv"], arrays["vertex_of_uv"]), None
        if "cut_faces" in arrays:
            cut = SurfaceCut(arrays["cut_corners"], arrays["cut_weights"], arrays["cut_faces"])
    except KeyError as error:
        raise UserError(f"{folder / ATLAS} lacks the array {error}; run {rerun_command('texture', folder)}") from None
    diffuse = read_rgb_float(map_files(folder, DIFFUSE)[-1])
    specular = read_rgb_float(map_files(folder, SPECULAR)[-1])[..., 0]
    coverage, (light, highlights) = read_gray(folder / COVERAGE), load_light(folder / LIGHT)
    normal, roughness = read_rgb_float(folder / NORMAL), read_rgb_float(folder / ROUGHNESS)[..., 0]
    return TextureArtifact(
        atlas,
        diffuse,
        np.ascontiguousarray(specular),
        coverage,
        light,
        highlights,
        normal if normal.shape[0] > 1 else None,
        cut,
        np.ascontiguousarray(roughness) if roughness.shape[0] > 1 else None,
    )
