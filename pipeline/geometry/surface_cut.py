"""Split the triangles of a mesh along the borders of regions, so that each triangle lies in one of them."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.geometry.mesh import Mesh

BISECTIONS = 6
"""Halvings of the interval of an edge in which the region changes: 1/64 of an edge, 0.1 mm."""

MIN_FRACTION = 0.02
"""A cut runs at least this fraction of an edge away from its ends, so that no faces without area arise."""

RegionOf = Callable[[Float[np.ndarray, "n 3"]], Int[np.ndarray, "n"]]
"""Points (m) -> region of each."""


@dataclass(frozen=True)
class SurfaceCut:
    """A mesh whose triangles are split; its first vertices are those of the mesh that was cut.

    Attributes:
        corners: three vertices of the old mesh for each new vertex; twice the same on an edge.
        weights: of the corners, sum 1.
        faces: indices into old and new vertices.
    """

    corners: Int[np.ndarray, "n 3"]
    weights: Float[np.ndarray, "n 3"]
    faces: Int[np.ndarray, "f 3"]

    def extend(self, values: Float[np.ndarray, "v c"]) -> Float[np.ndarray, "w c"]:
        """Return values of old and new vertices, for values of the old ones."""
        new = np.einsum("nk,nkc->nc", self.weights, values[self.corners].astype(np.float64))
        return np.concatenate([values, new.astype(values.dtype)])

    def extend_flags(self, flags: Bool[np.ndarray, "v"]) -> Bool[np.ndarray, "w"]:
        """Return flags of old and new vertices: a new one has the flag if all its corners have it."""
        return np.concatenate([flags, flags[self.corners].all(axis=1)])

    def apply(self, mesh: Mesh) -> Mesh:
        """Return the mesh with its triangles split: the same surface."""
        return Mesh(self.extend(mesh.vertices), self.faces)


@dataclass(frozen=True)
class UnsplitNormals:
    """How the vertices of a mesh whose triangles are split get the normals that they had before.

    The normal of a vertex is a mean over the triangles around it, weighted by their areas. At the corners of a triangle
    that was split, a part of it counts, which is seen as a line in the shading along the cut.

    Attributes:
        faces: triangles, some of them not split, whose normals count.
        rows: vertices on the edges and in the middle of triangles of `faces`; they have interpolated normals.
        corners: three vertices that are none of `rows`, for each of them.
        weights: of the corners, sum 1.
    """

    faces: Int[np.ndarray, "f 3"]
    rows: Int[np.ndarray, "n"]
    corners: Int[np.ndarray, "n 3"]
    weights: Float[np.ndarray, "n 3"]

    @classmethod
    def of_whole(cls, faces: Int[np.ndarray, "f 3"]) -> "UnsplitNormals":
        """Return the normals of a mesh none of whose triangles is split."""
        return cls(faces, np.zeros(0, np.int64), np.zeros((0, 3), np.int64), np.zeros((0, 3)))

    def vertex_normals(self, vertices: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "v 3"]:
        """Return unit normals for vertices in any pose."""
        normals = Mesh(vertices, self.faces).vertex_normals()
        between = np.einsum("nk,nkc->nc", self.weights, normals[self.corners].astype(np.float64))
        length = np.linalg.norm(between, axis=1, keepdims=True)
        normals[self.rows] = between / np.maximum(length, 1e-20)
        return normals


def cut_at_borders(mesh: Mesh, region_of: RegionOf) -> tuple[SurfaceCut, Int[np.ndarray, "g"]]:
    """Split triangles whose corners lie in several regions; return also the region of each new face.

    A triangle with corners in two regions becomes three, with corners in three regions six. Neighbours share the new
    vertices on their edge, so that a closed mesh stays closed.
    """
    faces = mesh.faces.astype(np.int64)
    region = region_of(mesh.vertices)
    edges = np.unique(np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2), axis=1), axis=0)
    edges = edges[region[edges[:, 0]] != region[edges[:, 1]]]
    fraction = _where_regions_change(mesh, edges, region, region_of)
    count = len(mesh.vertices)
    key = edges[:, 0] * count + edges[:, 1]
    of_faces = region[faces]
    differs = (of_faces != np.roll(of_faces, -1, axis=1)).sum(axis=1)
    whole = faces[differs == 0]
    two, three = _lone_corner_first(faces[differs == 2], region), faces[differs == 3]

    def on_edge(first: np.ndarray, second: np.ndarray) -> np.ndarray:
        low, high = np.minimum(first, second), np.maximum(first, second)
        return count + np.searchsorted(key, low * count + high)

    a, b, c = two.T
    ab, ca = on_edge(a, b), on_edge(c, a)
    parts, regions = [whole, *_stack((a, ab, ca), (ab, b, c), (ab, c, ca))], [region[whole[:, 0]]]
    regions += [region[a], region[b], region[b]]
    a, b, c = three.T
    ab, bc, ca = on_edge(a, b), on_edge(b, c), on_edge(c, a)
    middle = count + len(edges) + np.arange(len(three))
    for corner, after, before in ((a, ab, ca), (b, bc, ab), (c, ca, bc)):
        parts += _stack((corner, after, middle), (corner, middle, before))
        regions += [region[corner]] * 2
    corners = np.concatenate([edges[:, [0, 1, 1]], three])
    weights = np.concatenate(
        [np.stack([1.0 - fraction, fraction, 0.0 * fraction], axis=1), np.full((len(three), 3), 1.0 / 3.0)]
    )
    return SurfaceCut(corners, weights, np.concatenate(parts).astype(mesh.faces.dtype)), np.concatenate(regions)


def _stack(*triangles: tuple[np.ndarray, np.ndarray, np.ndarray]) -> list[np.ndarray]:
    return [np.stack(corners, axis=1) for corners in triangles]


def _where_regions_change(
    mesh: Mesh, edges: np.ndarray, region: np.ndarray, region_of: RegionOf
) -> Float[np.ndarray, "e"]:
    """Return the fraction of each edge at which the region of its first end is left, by bisection."""
    start, end = (mesh.vertices[edges[:, k]].astype(np.float64) for k in (0, 1))
    low, high = np.zeros(len(edges)), np.ones(len(edges))
    for _ in range(BISECTIONS if len(edges) else 0):
        middle = 0.5 * (low + high)
        inside = region_of(start + middle[:, None] * (end - start)) == region[edges[:, 0]]
        low, high = np.where(inside, middle, low), np.where(inside, high, middle)
    return np.clip(0.5 * (low + high), MIN_FRACTION, 1.0 - MIN_FRACTION)


def _lone_corner_first(faces: np.ndarray, region: np.ndarray) -> Int[np.ndarray, "f 3"]:
    """Return faces with corners in two regions, the corner that is alone in its region first."""
    of_faces = region[faces]
    alone = np.argmax((of_faces[:, :, None] == of_faces[:, None, :]).sum(axis=2) == 1, axis=1)
    return np.take_along_axis(faces, (alone[:, None] + np.arange(3)) % 3, axis=1)
