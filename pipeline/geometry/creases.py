"""Sharp folds of a mesh, such as the hem of a coat: each side of the edge has vertex normals of its own.

The mean of the normals around a vertex on such an edge points along the cloth, away from both sides. Shading needs a
copy of the vertex for each side then, as files have them along the seams of their texture.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pipeline.geometry.atlas import Atlas
from pipeline.geometry.mesh import Mesh

MIN_SMOOTH_COSINE = 0.0
"""Between the normals of two faces; below, they look away from each other and their edge is a fold."""
MIN_HEIGHT_RATIO = 1e-4
"""Height of a triangle over its longest edge up to which its normal is noise: float32 coordinates of a metre, edges of
half a centimetre."""


@dataclass(frozen=True)
class Creases:
    """A mesh with a copy of each vertex on a fold for each of its sides.

    Attributes:
        source: vertex of the mesh that each vertex is a copy of; first the vertices of the mesh, in their order.
        faces: in the order of the mesh, as indices into `source`.
    """

    source: Int[np.ndarray, "w"]
    faces: Int[np.ndarray, "f 3"]

    def on_fold(self) -> Bool[np.ndarray, "w"]:
        """Return which vertices have copies."""
        return np.asarray(np.bincount(self.source)[self.source] > 1)

    def join(self, vertices: Float[np.ndarray, "w 3"]) -> Mesh:
        """Return the mesh without copies; vertices: those of the mesh with copies, in any pose."""
        count = int(self.source.max(initial=-1)) + 1
        return Mesh(vertices[:count], self.source[self.faces].astype(self.faces.dtype))

    def split_atlas(self, atlas: Atlas) -> Atlas:
        """Return the layout of the mesh with copies: nothing moves, corners on a fold inside a chart are doubled."""
        count = len(self.source)
        pairs, corners = np.unique(atlas.faces_uv.astype(np.int64) * count + self.faces, return_inverse=True)
        faces_uv = corners.reshape(-1, 3).astype(atlas.faces_uv.dtype)
        return Atlas(atlas.uv[pairs // count], faces_uv, (pairs % count).astype(atlas.vertex_of_uv.dtype))


def find_creases(mesh: Mesh) -> Creases:
    """Return the copies for a mesh; corners of faces share a copy where edges that are no fold connect them."""
    faces, count = mesh.faces.astype(np.int64), len(mesh.vertices)
    first, second = _smooth_half_edges(mesh, faces)
    pairs = np.stack([np.r_[first, _next(first)], np.r_[_next(second), second]])
    graph = coo_array((np.ones(pairs.shape[1]), pairs), shape=(faces.size, faces.size))
    copy_of_corner = connected_components(graph, directed=False)[1]
    source = np.zeros(copy_of_corner.max(initial=-1) + 1, dtype=np.int64)
    source[copy_of_corner] = faces.ravel()
    order = np.argsort(source, kind="stable")
    is_first = np.diff(source[order], prepend=-1) > 0
    number = np.empty(len(source), dtype=np.int64)
    number[order[is_first]] = source[order[is_first]]
    others = order[~is_first]
    number[others] = count + np.arange(len(others))
    return Creases(
        np.concatenate([np.arange(count), source[others]]),
        number[copy_of_corner].reshape(-1, 3).astype(mesh.faces.dtype),
    )


def _smooth_half_edges(mesh: Mesh, faces: Int[np.ndarray, "f 3"]) -> tuple[Int[np.ndarray, "e"], Int[np.ndarray, "e"]]:
    """Return the half edges of all edges between two faces that are no fold, numbered by the corner they start at."""
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    key = np.minimum(start, end) * len(mesh.vertices) + np.maximum(start, end)
    order = np.argsort(key, kind="stable")
    _, at, sharing = np.unique(key[order], return_index=True, return_counts=True)
    first, second = order[at[sharing == 2]], order[at[sharing == 2] + 1]
    normals = mesh.face_normals().astype(np.float64)
    normals[_is_line(mesh)] = 0.0
    cosine = np.sum(normals[first // 3] * normals[second // 3], axis=1)
    smooth = (cosine >= MIN_SMOOTH_COSINE) & (start[first] == end[second])
    return first[smooth], second[smooth]


def _is_line(mesh: Mesh) -> Bool[np.ndarray, "f"]:
    """Return the faces without area, whose normals are made of rounding errors."""
    corners = mesh.vertices.astype(np.float64)[mesh.faces]
    edges = np.roll(corners, -1, axis=1) - corners
    return np.asarray(
        2.0 * mesh.face_areas_m2() <= MIN_HEIGHT_RATIO * np.square(edges).sum(axis=2).max(axis=1, initial=0.0)
    )


def _next(half_edge: Int[np.ndarray, "e"]) -> Int[np.ndarray, "e"]:
    """Return the half edge that follows in the same face."""
    return np.asarray(half_edge // 3 * 3 + (half_edge + 1) % 3)
