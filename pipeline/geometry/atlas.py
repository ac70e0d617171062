"""Texture atlases: parametrisation of a mesh and the surface point of each texel.

The UV origin is bottom-left; row 0 of a texture is at the top (v = 1); texel centres are at +0.5.
"""

from dataclasses import dataclass

import numpy as np
import torch
import xatlas
from jaxtyping import Bool, Float, Int

from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import smooth_taubin
from pipeline.kernels.raster import rasterize

_XATLAS_OVERSHOOT = 1.4
"""Factor of the padding: xatlas exceeds the requested resolution by up to 38 % (measured), and the atlas is then scaled
down to that resolution together with its padding."""

SMOOTHING_STEPS = 5


@dataclass(frozen=True)
class Atlas:
    """The parametrisation of a mesh.

    uv: texture coordinates in [0, 1]. faces_uv: corners of the mesh's faces as indices into `uv`. vertex_of_uv: mesh
    vertex of each texture coordinate.
    """

    uv: Float[np.ndarray, "t 2"]
    faces_uv: Int[np.ndarray, "f 3"]
    vertex_of_uv: Int[np.ndarray, "t"]


@dataclass(frozen=True)
class Texels:
    """The texels whose centres are covered by a chart.

    size_px: side of the texture. rows, columns: position in the texture. face: mesh face of each texel. barycentric:
    barycentric coordinates of the texel centre in that face, sum 1.
    """

    size_px: int
    rows: Int[np.ndarray, "t"]
    columns: Int[np.ndarray, "t"]
    face: Int[np.ndarray, "t"]
    barycentric: Float[np.ndarray, "t 3"]

    def select(self, chosen: Bool[np.ndarray, "t"]) -> "Texels":
        """Return some of the texels."""
        arrays = (values[chosen] for values in (self.rows, self.columns, self.face, self.barycentric))
        return Texels(self.size_px, *arrays)

    def coverage_mask(self) -> Bool[np.ndarray, "s s"]:
        """Return a texture that is True at the covered texels."""
        mask = np.zeros((self.size_px, self.size_px), dtype=bool)
        mask[self.rows, self.columns] = True
        return mask

    def to_texture(self, values: Float[np.ndarray, "t c"]) -> Float[np.ndarray, "s s c"]:
        """Return a texture with the values at the covered texels and 0 elsewhere."""
        texture = np.zeros((self.size_px, self.size_px, values.shape[1]), dtype=np.float32)
        texture[self.rows, self.columns] = values
        return texture

    def interpolate(
        self, faces: Int[np.ndarray, "f 3"], attributes: Float[np.ndarray, "v c"]
    ) -> Float[np.ndarray, "t c"]:
        """Interpolate vertex attributes at the surface points of the texels."""
        corners = faces[self.face]
        value = self.barycentric[:, 0, None] * attributes[corners[:, 0]]
        for k in (1, 2):
            value += self.barycentric[:, k, None] * attributes[corners[:, k]]
        return value


def texture_size_px(
    area_m2: float, pixel_footprint_m: float, min_size_px: int, max_size_px: int, utilisation: float = 0.65
) -> int:
    """Return the smallest power of two with texels not larger than the footprint of an image pixel.

    Args:
        area_m2: area of the surface.
        pixel_footprint_m: length that one pixel of the capture covers on the surface, m.
        min_size_px, max_size_px: limits of the result.
        utilisation: fraction of the atlas that charts cover.

    >>> texture_size_px(1.8, 0.0035, 256, 4096)
    512
    """
    needed = np.sqrt(area_m2 / utilisation) / pixel_footprint_m
    return int(np.clip(2 ** int(np.ceil(np.log2(needed))), min_size_px, max_size_px))


def unwrap(
    mesh: Mesh,
    segment_of_face: Int[np.ndarray, "f"],
    size_px: int,
    padding_px: int,
    smoothing_steps: int = SMOOTHING_STEPS,
) -> Atlas:
    """Parametrise a mesh with xatlas (Young, 2018), each segment separately.

    Separate segments give more charts (120 instead of 66 on a body of 51k faces) in less time (4 s instead of 19 s):
    chart growing takes more than linear time in the number of connected faces, and segments are processed in parallel.
    The result does not depend on the number of threads. A smoothed copy of the mesh is parametrised, because charts end
    at the noise of a reconstructed surface (756 charts without smoothing, 282 with, on a mesh of 46k faces).

    Args:
        mesh: the mesh.
        segment_of_face: label of each face; charts do not cross segments.
        size_px: side of the texture.
        padding_px: smallest distance between charts, texels.
        smoothing_steps: of the copy; 0 for a mesh without noise, whose faces then keep their proportions.
    """
    atlas, smoothed = xatlas.Atlas(), smooth_taubin(mesh, smoothing_steps).vertices
    faces_of_segment, vertices_of_segment = [], []
    for segment in np.unique(segment_of_face):
        rows = np.flatnonzero(segment_of_face == segment)
        vertices, corners = np.unique(mesh.faces[rows], return_inverse=True)
        atlas.add_mesh(np.ascontiguousarray(smoothed[vertices]), corners.reshape(-1, 3).astype(np.uint32))
        faces_of_segment.append(rows)
        vertices_of_segment.append(vertices)
    packing = xatlas.PackOptions()
    packing.resolution, packing.bilinear = size_px, True
    packing.padding = int(np.ceil(padding_px * _XATLAS_OVERSHOOT))
    atlas.generate(xatlas.ChartOptions(), packing, False)

    uv, vertex_of_uv, count = [], [], 0
    faces_uv = np.zeros_like(mesh.faces, dtype=np.int32)
    for segment, (rows, vertices) in enumerate(zip(faces_of_segment, vertices_of_segment, strict=True)):
        vertex_of_segment, corners, segment_uv = atlas[segment]
        faces_uv[rows] = corners.astype(np.int32) + count
        uv.append(segment_uv)
        vertex_of_uv.append(vertices[vertex_of_segment])
        count += len(segment_uv)
    return Atlas(np.concatenate(uv).astype(np.float32), faces_uv, np.concatenate(vertex_of_uv).astype(np.int32))


def rasterize_texels(atlas: Atlas, size_px: int) -> Texels:
    """Return the texels of a texture with the surface point of each."""
    position_px = atlas.uv * np.float32(size_px)
    position_px[:, 1] = size_px - position_px[:, 1]
    ones = torch.ones(len(position_px))
    face_id, barycentric, _ = rasterize(
        torch.from_numpy(position_px), ones, torch.from_numpy(atlas.faces_uv), size_px, size_px
    )
    rows, columns = np.nonzero(face_id.numpy() >= 0)
    return Texels(
        size_px,
        rows.astype(np.int32),
        columns.astype(np.int32),
        face_id.numpy()[rows, columns],
        barycentric.numpy()[rows, columns],
    )
