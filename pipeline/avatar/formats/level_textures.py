"""Textures of a level of detail: each texel gets the colour of the closest point of the full mesh.

With the texture coordinates of the full mesh, a collapse across a seam would leave faces without a place in their chart
(4 % of the vertices at half of the faces, 16 % at a quarter): stripes along seams become ragged.

Reference: Cohen et al., "Appearance-preserving simplification", SIGGRAPH 1998: the deviation of texture coordinates.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8

from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import closest_points_on_mesh
from pipeline.geometry.tangents import tangent_frames
from pipeline.geometry.texture_rendering import sample_texture
from pipeline.io.image import resize, to_float, to_uint8
from pipeline.kernels.raster import rasterize
from pipeline.texture.edge_padding import fill_unknown_texels
from pipeline.texture.files import FLAT_NORMAL
from pipeline.texture.normal_map import MIN_COSINE, decode_normals, encode_normals

_QUARTER = ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25))
"""Samples of a texel, in texels: the centres of its quarters, so that an unmoved texel is their exact mean."""


@dataclass(frozen=True)
class UvMesh:
    """A mesh with one texture coordinate a vertex.

    Attributes:
        uv: origin top-left, as in glTF.
        normals: of unit length.
        tangents: as in glTF; None without a normal map.
    """

    positions_m: Float[np.ndarray, "v 3"]
    uv: Float[np.ndarray, "v 2"]
    faces: Int[np.ndarray, "f 3"]
    normals: Float[np.ndarray, "v 3"]
    tangents: Float[np.ndarray, "v 4"] | None = None


def join_meshes(meshes: Sequence[UvMesh]) -> UvMesh:
    """Return several meshes as one."""
    first = np.cumsum([0, *(len(mesh.uv) for mesh in meshes[:-1])])
    tangents = [mesh.tangents for mesh in meshes]
    return UvMesh(
        np.concatenate([mesh.positions_m for mesh in meshes]),
        np.concatenate([mesh.uv for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, first, strict=True)]),
        np.concatenate([mesh.normals for mesh in meshes]),
        None if any(t is None for t in tangents) else np.concatenate([t for t in tangents if t is not None]),
    )


@dataclass(frozen=True)
class SurfacePoints:
    """Points on a mesh: the vertices of their faces, and barycentric coordinates."""

    corners: Int[np.ndarray, "n 3"]
    barycentric: Float[np.ndarray, "n 3"]

    def frames(self, mesh: UvMesh) -> Float[np.ndarray, "n 3 3"]:
        """Return the matrices from the tangent space of a mesh with tangents."""
        if mesh.tangents is None:
            raise ValueError("a mesh without tangents has no tangent space")
        normals, tangents = (
            np.einsum("nk,nkc->nc", self.barycentric, values[self.corners].astype(np.float64))
            for values in (mesh.normals, mesh.tangents)
        )
        return tangent_frames(normals, tangents)


@dataclass(frozen=True)
class TexelSources:
    """Where the texels of a new texture come from.

    Attributes:
        uv: in the old texture, origin top-left.
        covered: texels that faces of the new mesh show.
        old, new: where these are on the old and on the new mesh.
    """

    uv: Float[np.ndarray, "h w 2"]
    covered: Bool[np.ndarray, "h w"]
    old: SurfacePoints
    new: SurfacePoints


def find_texel_sources(full: UvMesh, reduced: UvMesh, height_px: int, width_px: int) -> TexelSources:
    """Return for each texel of the reduced mesh the texture coordinate of the closest point of the full mesh.

    Both meshes are in the same pose. A texel that no face covers keeps its own coordinate.
    """
    pixels = torch.from_numpy((reduced.uv * [width_px, height_px]).astype(np.float32))
    faces = torch.from_numpy(reduced.faces.astype(np.int32))
    face_id, barycentric, _ = rasterize(pixels, torch.ones(len(pixels)), faces, height_px, width_px)
    covered = face_id.numpy() >= 0
    corners = reduced.faces[face_id.numpy()[covered]]
    points_m = np.einsum("tk,tkc->tc", barycentric.numpy()[covered], reduced.positions_m[corners])
    _, face, weights = closest_points_on_mesh(points_m, Mesh(full.positions_m, full.faces.astype(np.int32)))
    columns, rows = np.meshgrid((np.arange(width_px) + 0.5) / width_px, (np.arange(height_px) + 0.5) / height_px)
    uv = np.stack([columns, rows], axis=2)
    uv[covered] = np.einsum("tk,tkc->tc", weights, full.uv[full.faces[face]])
    own = SurfacePoints(corners, barycentric.numpy()[covered].astype(np.float64))
    return TexelSources(uv, covered, SurfacePoints(full.faces[face], weights), own)


def bake_normals(
    pixels: UInt8[np.ndarray, "h w 3"], sources: TexelSources, full: UvMesh, reduced: UvMesh
) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Return the normal map of the reduced mesh: the normals that the full mesh shows with its own, in other frames.

    pixels: normal map of the full mesh.
    """
    uv = sources.uv[sources.covered] * [1.0, -1.0] + [0.0, 1.0]
    normals = decode_normals(to_float(pixels), uv, sources.old.frames(full))
    frames = sources.new.frames(reduced)
    is_in_front = np.sum(frames[..., 2] * normals, axis=1) > MIN_COSINE
    image = np.tile(np.array(FLAT_NORMAL, np.float32), (*sources.covered.shape, 1))
    image[sources.covered] = encode_normals(frames, normals, is_in_front)
    return to_uint8(fill_unknown_texels(image, sources.covered))


def bake_texture(pixels: UInt8[np.ndarray, "h w c"], sources: TexelSources) -> UInt8[np.ndarray, "h2 w2 c"]:
    """Return the new texture; texels that no face covers are filled from their neighbours.

    pixels: the old texture, of the same size or larger by a power of two.
    """
    height_px, width_px = sources.covered.shape
    twice = (min(2 * height_px, pixels.shape[0]), min(2 * width_px, pixels.shape[1]))
    if pixels.shape[:2] != twice:
        pixels = resize(pixels, twice[1], twice[0], "box")
    texture = torch.from_numpy(pixels.astype(np.float32) / 255.0)
    uv = sources.uv.reshape(-1, 2)
    is_halved = twice[0] > height_px
    offsets = np.array(_QUARTER if is_halved else ((0.0, 0.0),)) / [width_px, height_px]
    total = np.zeros((len(uv), pixels.shape[2]), np.float32)
    for offset in offsets:
        shifted = (uv + offset) * [1.0, -1.0] + [0.0, 1.0]
        total += sample_texture(texture, torch.from_numpy(shifted.astype(np.float32))).numpy()
    image = (total / len(offsets)).reshape(height_px, width_px, -1)
    return to_uint8(fill_unknown_texels(image, sources.covered))
