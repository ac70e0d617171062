"""Levels of detail: the avatar with fewer triangles and smaller textures, with the same skeleton, skin and clips.

The textures are baked anew for the faces of the level (`level_textures`).

Each level is a whole file of its own. The extension MSFT_lod would put all levels into one file, but the loaders of
three.js, glTFast and Blender do not read it.
"""

from typing import Any

import numpy as np

from pipeline.avatar.formats.level_textures import TexelSources, UvMesh, bake_texture, find_texel_sources
from pipeline.geometry.simplification import collapse_textured_edges
from pipeline.io.glb import GlbFile
from pipeline.io.glb_writer import GlbWriter
from pipeline.io.image import png_bytes

FACE_RATIOS = (0.5, 0.25)
"""Faces of each coarser level as a share of those of the avatar; the avatar itself is the finest level."""

MIN_TEXTURE_PX = 64


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
    meshes = [
        _reduce_primitive(file, document, primitive, face_ratio)
        for mesh in document.json["meshes"]
        for primitive in mesh["primitives"]
    ]
    full, reduced = (_join(list(parts)) for parts in zip(*meshes, strict=True))
    sources: dict[tuple[int, int], TexelSources] = {}
    for index in range(len(document.json.get("images", ()))):
        pixels = file.image_pixels(index)
        size_px = _halved_size(pixels, texture_halvings)
        if size_px not in sources:
            sources[size_px] = find_texel_sources(full, reduced, *size_px)
        document.replace_image(index, png_bytes(bake_texture(pixels, sources[size_px])), "image/png")
    document.remove_unused()
    return document.to_bytes()


def _reduce_primitive(
    file: GlbFile, document: GlbWriter, primitive: dict[str, Any], face_ratio: float
) -> tuple[UvMesh, UvMesh]:
    """Reduce the faces of a primitive in the document; return its mesh before and after."""
    attributes = primitive["attributes"]
    faces = file.accessor(primitive["indices"]).reshape(-1, 3)
    positions_m, uv = file.accessor(attributes["POSITION"]), file.accessor(attributes["TEXCOORD_0"])
    reduced = collapse_textured_edges(positions_m, uv, faces, round(face_ratio * len(faces)))
    index_dtype = np.uint16 if len(reduced.uv) < 65535 else np.uint32
    document.replace_array(primitive["indices"], reduced.faces.reshape(-1).astype(index_dtype))
    document.replace_array(attributes["TEXCOORD_0"], reduced.uv)
    per_vertex = [index for name, index in attributes.items() if name != "TEXCOORD_0"]
    per_vertex += [index for target in primitive.get("targets", ()) for index in target.values()]
    for index in per_vertex:
        document.replace_array(index, file.stored_array(index)[reduced.source_vertex])
    return UvMesh(positions_m, uv, faces), UvMesh(positions_m[reduced.source_vertex], reduced.uv, reduced.faces)


def _join(meshes: list[UvMesh]) -> UvMesh:
    """Return one mesh of all primitives; they share the textures."""
    first = np.cumsum([0, *(len(mesh.uv) for mesh in meshes[:-1])])
    return UvMesh(
        np.concatenate([mesh.positions_m for mesh in meshes]),
        np.concatenate([mesh.uv for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, first, strict=True)]),
    )


def _halved_size(pixels: np.ndarray, halvings: int) -> tuple[int, int]:
    height_px, width_px = (max(side_px >> halvings, min(side_px, MIN_TEXTURE_PX)) for side_px in pixels.shape[:2])
    return height_px, width_px
