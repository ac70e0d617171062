"""Texture atlases: unfolding a mesh, which surface point each texel shows, and filling what no chart covers.

UV has its origin bottom-left; row 0 of a texture is at the top (v = 1); texel centres lie at +0.5.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
import xatlas
from jaxtyping import Bool, Float, Int

from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import smooth_taubin
from pipeline.kernels.raster import rasterize

# xatlas estimates its scale and overshoots the asked resolution, by up to 38 % in the cases measured: the gutter must
# survive being shrunk by as much
_XATLAS_OVERSHOOT = 1.4
SMOOTHING_STEPS = 5


@dataclass(frozen=True)
class Atlas:
    """An unfolded mesh.

    uv: positions in [0, 1]; faces_uv: the mesh's faces as corners into `uv`; vertex_of_uv: mesh vertex of each uv.
    """

    uv: Float[np.ndarray, "t 2"]
    faces_uv: Int[np.ndarray, "f 3"]
    vertex_of_uv: Int[np.ndarray, "t"]


@dataclass(frozen=True)
class Texels:
    """The texels whose centres lie on the surface.

    rows, columns: place in the texture; face: mesh face; barycentric: of the texel's centre in that face, sum 1.
    """

    size_px: int
    rows: Int[np.ndarray, "t"]
    columns: Int[np.ndarray, "t"]
    face: Int[np.ndarray, "t"]
    barycentric: Float[np.ndarray, "t 3"]

    def covered(self) -> Bool[np.ndarray, "s s"]:
        """True where a texel's centre lies on the surface."""
        covered = np.zeros((self.size_px, self.size_px), dtype=bool)
        covered[self.rows, self.columns] = True
        return covered

    def image(self, values: Float[np.ndarray, "t c"]) -> Float[np.ndarray, "s s c"]:
        """Values of the texels as a picture, 0 elsewhere."""
        image = np.zeros((self.size_px, self.size_px, values.shape[1]), dtype=np.float32)
        image[self.rows, self.columns] = values
        return image

    def interpolate(
        self, faces: Int[np.ndarray, "f 3"], attributes: Float[np.ndarray, "v c"]
    ) -> Float[np.ndarray, "t c"]:
        """Vertex attributes at the texels' surface points."""
        corners = faces[self.face]
        value = self.barycentric[:, 0, None] * attributes[corners[:, 0]]
        for k in (1, 2):
            value += self.barycentric[:, k, None] * attributes[corners[:, k]]
        return value


def texture_size_px(
    area_m2: float, pixel_footprint_m: float, min_size_px: int, max_size_px: int, utilisation: float = 0.65
) -> int:
    """The power of two whose texels are not larger than what one pixel of the capture sees.

    area_m2: of the surface; footprint_m: of a pixel on the person; utilisation: share of an atlas that charts cover.

    >>> texture_size_px(1.8, 0.0035, 256, 4096)
    512
    """
    needed = np.sqrt(area_m2 / utilisation) / pixel_footprint_m
    return int(np.clip(2 ** int(np.ceil(np.log2(needed))), min_size_px, max_size_px))


def unwrap(mesh: Mesh, segment_of_face: Int[np.ndarray, "f"], size_px: int, padding_px: int) -> Atlas:
    """Unfold a mesh with xatlas (Young, 2018), every part of it by itself.

    Cutting at `segment_of_face` (any labels) first costs charts (120 instead of 66 on a body of 51k faces) and saves
    time
    (4 s instead of 19 s): growing charts takes worse than linear time in the faces of a connected piece, and pieces are
    worked on in parallel. The result does not depend on the number of threads. What is unfolded is a smoothed copy: on
    the noise of a reconstructed surface charts end at every dent (756 charts, smoothed 282, on a mesh of 46k faces).

    padding_px: least gutter between charts in a texture of `size_px`.
    """
    atlas, smoothed = xatlas.Atlas(), smooth_taubin(mesh, SMOOTHING_STEPS).vertices
    rows_of_part, vertices_of_part = [], []
    for part in np.unique(segment_of_face):
        rows = np.flatnonzero(segment_of_face == part)
        vertices, corners = np.unique(mesh.faces[rows], return_inverse=True)
        atlas.add_mesh(np.ascontiguousarray(smoothed[vertices]), corners.reshape(-1, 3).astype(np.uint32))
        rows_of_part.append(rows)
        vertices_of_part.append(vertices)
    packing = xatlas.PackOptions()
    packing.resolution, packing.bilinear = size_px, True
    packing.padding = int(np.ceil(padding_px * _XATLAS_OVERSHOOT))
    atlas.generate(xatlas.ChartOptions(), packing, False)

    uv, vertex_of_uv, count = [], [], 0
    faces_uv = np.zeros_like(mesh.faces, dtype=np.int32)
    for part, (rows, vertices) in enumerate(zip(rows_of_part, vertices_of_part, strict=True)):
        vertex_of_part, corners, part_uv = atlas[part]
        faces_uv[rows] = corners.astype(np.int32) + count
        uv.append(part_uv)
        vertex_of_uv.append(vertices[vertex_of_part])
        count += len(part_uv)
    return Atlas(np.concatenate(uv).astype(np.float32), faces_uv, np.concatenate(vertex_of_uv).astype(np.int32))


def rasterize_texels(atlas: Atlas, size_px: int) -> Texels:
    """Which surface point lies under every texel's centre."""
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


def fill_unknown_texels(
    image: Float[np.ndarray, "h w c"], known: Bool[np.ndarray, "h w"], dilation_px: int = 2
) -> Float[np.ndarray, "h w c"]:
    """Colours for unknown texels, so that neither bilinear look-ups nor mip levels reach a colour that is nowhere.

    The nearest `dilation_px` rings take the mean of their known neighbours; the rest is filled by push-pull (Gortler et
    al., "The Lumigraph", 1996): coarser and coarser means of what is known, taken back up where finer levels know
    nothing. All stays 0 when nothing is known.
    """
    colour = np.where(known[..., None], image, 0.0).astype(np.float32)
    weight = known.astype(np.float32)
    for _ in range(dilation_px):
        near_weight = cv2.boxFilter(weight, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
        near = cv2.boxFilter(colour * weight[..., None], -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
        new = (weight == 0) & (near_weight > 0.5)
        colour[new] = near.reshape(colour.shape)[new] / near_weight[new][:, None]
        weight[new] = 1.0
    return _push_pull(colour, weight)


def _push_pull(colour: np.ndarray, weight: np.ndarray) -> np.ndarray:
    height, width = weight.shape
    if weight.size == 1 or weight.min() > 0:
        return colour
    even = ((0, height % 2), (0, width % 2))
    summed = _sum_2x2(np.pad(colour * weight[..., None], (*even, (0, 0))))
    count = _sum_2x2(np.pad(weight, even)[..., None])
    coarse = _push_pull(summed / np.maximum(count, 1e-8), np.minimum(count[..., 0], 1.0))
    finer = cv2.resize(coarse, (2 * coarse.shape[1], 2 * coarse.shape[0]), interpolation=cv2.INTER_LINEAR)
    finer = finer.reshape(2 * coarse.shape[0], 2 * coarse.shape[1], -1)[:height, :width]
    return np.where(weight[..., None] > 0, colour, finer).astype(np.float32)


def _sum_2x2(values: np.ndarray) -> np.ndarray:
    height, width, channels = values.shape
    return values.reshape(height // 2, 2, width // 2, 2, channels).sum(axis=(1, 3))
