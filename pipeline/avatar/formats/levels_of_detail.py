"""Levels of detail: the avatar with fewer triangles and smaller textures, with the same skeleton, skin and clips.

Each level has its own texture coordinates and textures, baked from those of the avatar (`level_textures`). A normal map
shows the normals that the avatar's shows, in the tangent space of the level.

Each level is a whole file of its own. The extension MSFT_lod would put all levels into one file, but the loaders of
three.js, glTFast and Blender do not read it.
"""

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from pipeline.avatar.formats.level_textures import (
    TexelSources,
    UvMesh,
    bake_normals,
    bake_texture,
    find_texel_sources,
    join_meshes,
)
from pipeline.avatar.formats.normal_maps import normal_images, remove_normal_maps
from pipeline.geometry.atlas import Atlas, unwrap
from pipeline.geometry.creases import find_creases
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.simplification import ReducedFaces, collapse_edges
from pipeline.geometry.tangents import vertex_tangents
from pipeline.io.glb import GlbFile
from pipeline.io.glb_writer import GlbWriter
from pipeline.io.image import png_bytes

FACE_RATIOS = (0.5, 0.25)
"""Faces of each coarser level as a share of those of the avatar; the avatar itself is the finest level."""

MIN_TEXTURE_PX = 64

SMOOTHING_STEPS = 0

PADDING_PX = 1
"""Distance of charts in the textures of a level."""


def encode_levels(file: GlbFile) -> list[bytes]:
    """Return the coarser levels of an avatar as .glb files, one for each of `FACE_RATIOS`.

    Each level halves the side of the textures once more, as a viewer's mip maps do at twice the distance.

    Raises:
        UserError: the file's arrays or images cannot be read.
    """
    return [encode_level(file, ratio, level) for level, ratio in enumerate(FACE_RATIOS, 1)]


def encode_level(file: GlbFile, face_ratio: float, texture_halvings: int) -> bytes:
    """Return a .glb with fewer faces: all vertices are vertices of the full mesh, with its normals, skin and morphs.

    Args:
        file: triangle lists with texture coordinates.
        face_ratio: share of the faces that is left, in (0, 1].
        texture_halvings: how often the sides of the textures are halved; not below `MIN_TEXTURE_PX`.

    Raises:
        UserError: the file's arrays or images cannot be read.
    """
    document = GlbWriter.from_file(file)
    primitives = [primitive for mesh in document.json["meshes"] for primitive in mesh["primitives"]]
    has_tangents = all("TANGENT" in primitive["attributes"] for primitive in primitives)
    kept = range(len(file.gltf.get("images", ()))) if has_tangents else remove_normal_maps(document.json)
    images, maps_of_normals = [file.image_pixels(index) for index in kept], normal_images(document.json)
    full = [_uv_mesh(file, primitive) for primitive in primitives]
    reduced = [collapse_edges(mesh.positions_m, mesh.faces, round(face_ratio * len(mesh.faces))) for mesh in full]
    sizes_px = [_halved_size(pixels, texture_halvings) for pixels in images]
    atlas = _unwrap_together(full, reduced, max((max(size_px) for size_px in sizes_px), default=MIN_TEXTURE_PX))
    level = []
    for mesh, part, layout, primitive in zip(full, reduced, atlas, primitives, strict=True):
        source, uv, faces = _split_folds(mesh, part, layout)
        normals = mesh.normals[source]
        tangents = vertex_tangents(mesh.positions_m[source], normals, uv * [1.0, -1.0] + [0.0, 1.0], faces)
        level.append(UvMesh(mesh.positions_m[source], uv, faces, normals, tangents if has_tangents else None))
        _replace_primitive(file, document, primitive, source, level[-1])
    sources: dict[tuple[int, int], TexelSources] = {}
    both = join_meshes(full), join_meshes(level)
    for index, (pixels, size_px) in enumerate(zip(images, sizes_px, strict=True)):
        if size_px not in sources:
            sources[size_px] = find_texel_sources(*both, *size_px)
        is_normals = index in maps_of_normals
        baked = bake_normals(pixels, sources[size_px], *both) if is_normals else bake_texture(pixels, sources[size_px])
        document.replace_image(index, png_bytes(baked), "image/png")
    document.remove_unused()
    return document.to_bytes()


def _uv_mesh(file: GlbFile, primitive: dict[str, Any]) -> UvMesh:
    names = primitive["attributes"]
    faces = file.accessor(primitive["indices"]).reshape(-1, 3)
    tangents = file.accessor(names["TANGENT"]) if "TANGENT" in names else None
    positions_m, uv, normals = (file.accessor(names[name]) for name in ("POSITION", "TEXCOORD_0", "NORMAL"))
    return UvMesh(positions_m, uv, faces, normals, tangents)


def _unwrap_together(full: list[UvMesh], reduced: list[ReducedFaces], size_px: int) -> list[Atlas]:
    """Parametrise all primitives in one atlas.

    Returns:
        Of each primitive the layout of `reduced`, with the origin of its texture coordinates top-left.
    """
    first = np.cumsum([0, *(len(part.source_vertex) for part in reduced)])
    positions_m = np.concatenate([m.positions_m[p.source_vertex] for m, p in zip(full, reduced, strict=True)])
    faces = np.concatenate([part.faces + start for part, start in zip(reduced, first[:-1], strict=True)])
    segment = np.repeat(np.arange(len(reduced)), [len(part.faces) for part in reduced])
    atlas = unwrap(Mesh(positions_m, faces.astype(np.int32)), segment, size_px, PADDING_PX, SMOOTHING_STEPS)
    parts = []
    for number in range(len(reduced)):
        used, corners = np.unique(atlas.faces_uv[segment == number], return_inverse=True)
        uv = np.stack([atlas.uv[used, 0], 1.0 - atlas.uv[used, 1]], axis=1)
        parts.append(Atlas(uv, corners.reshape(-1, 3), atlas.vertex_of_uv[used] - first[number]))
    return parts


def _split_folds(
    full: UvMesh, part: ReducedFaces, atlas: Atlas
) -> tuple[Int[np.ndarray, "t"], Float[np.ndarray, "t 2"], Int[np.ndarray, "g 3"]]:
    """Return vertices of the full mesh, texture coordinates and faces of a level; each side of a fold has its normals.

    Of the copies of a vertex of the full mesh, a corner takes the one whose normal is nearest to that of the level.
    """
    reduced = Mesh(full.positions_m[part.source_vertex], part.faces)
    creases = find_creases(reduced)
    layout = creases.split_atlas(atlas)
    wanted = Mesh(reduced.vertices[creases.source], creases.faces).vertex_normals()[layout.vertex_of_uv]
    source = part.source_vertex[creases.source[layout.vertex_of_uv]]
    place = np.unique(full.positions_m, axis=0, return_inverse=True)[1].reshape(-1)
    copies, count = np.argsort(place, kind="stable"), np.bincount(place)
    first = np.cumsum(count) - count
    best = np.sum(full.normals[source] * wanted, axis=1)
    for number in range(count.max(initial=0)):
        other = copies[first[place[source]] + np.minimum(number, count[place[source]] - 1)]
        cosine = np.sum(full.normals[other] * wanted, axis=1)
        source, best = np.where(cosine > best, other, source), np.maximum(cosine, best)
    return source, layout.uv, layout.faces_uv


def _replace_primitive(
    file: GlbFile, document: GlbWriter, primitive: dict[str, Any], source: Int[np.ndarray, "t"], mesh: UvMesh
) -> None:
    """Write the faces and texture coordinates of a mesh, and what else the source vertices have."""
    attributes = primitive["attributes"]
    index_dtype = np.uint16 if len(mesh.uv) < 65535 else np.uint32
    document.replace_array(primitive["indices"], mesh.faces.reshape(-1).astype(index_dtype))
    document.replace_array(attributes["TEXCOORD_0"], mesh.uv)
    per_vertex = [index for name, index in attributes.items() if name != "TEXCOORD_0"]
    per_vertex += [index for target in primitive.get("targets", ()) for index in target.values()]
    for index in per_vertex:
        document.replace_array(index, file.stored_array(index)[source])
    if mesh.tangents is not None:
        document.replace_array(attributes["TANGENT"], mesh.tangents)


def _halved_size(pixels: np.ndarray, halvings: int) -> tuple[int, int]:
    height_px, width_px = (max(side_px >> halvings, min(side_px, MIN_TEXTURE_PX)) for side_px in pixels.shape[:2])
    return height_px, width_px
