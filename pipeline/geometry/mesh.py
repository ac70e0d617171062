"""Triangle meshes as arrays, and quantities that follow from vertices and faces."""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh: vertices in metres; faces are counter-clockwise seen from outside."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]

    def face_normals(self) -> Float[np.ndarray, "f 3"]:
        """Return unit normals; zero for faces without area."""
        cross = self._face_cross_products()
        return cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-20)

    def face_areas_m2(self) -> Float[np.ndarray, "f"]:
        """Return the area of each face in square metres."""
        return 0.5 * np.linalg.norm(self._face_cross_products(), axis=1)

    def vertex_normals(self) -> Float[np.ndarray, "v 3"]:
        """Return area-weighted unit normals; zero at vertices without faces."""
        cross = self._face_cross_products()
        normals = np.zeros((len(self.vertices), 3))
        for corner in range(3):
            for axis in range(3):
                normals[:, axis] += np.bincount(self.faces[:, corner], cross[:, axis], minlength=len(self.vertices))
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)
        return normals.astype(self.vertices.dtype)

    def edges(self) -> Int[np.ndarray, "e 2"]:
        """Return the undirected edges, each once, the smaller vertex index first, in lexicographic order."""
        ends = np.sort(igl.edges(self.faces.astype(np.int64)), axis=1)
        return ends[np.lexsort((ends[:, 1], ends[:, 0]))].astype(self.faces.dtype)

    def is_watertight(self) -> bool:
        """Return whether the mesh is closed, edge-manifold and consistently wound.

        This holds if every directed edge occurs once and its opposite edge occurs once.
        """
        half_edges = np.concatenate([self.faces[:, [0, 1]], self.faces[:, [1, 2]], self.faces[:, [2, 0]]])
        forward = half_edges[:, 0].astype(np.int64) * len(self.vertices) + half_edges[:, 1]
        backward = half_edges[:, 1].astype(np.int64) * len(self.vertices) + half_edges[:, 0]
        unique = np.unique(forward)
        return len(half_edges) > 0 and len(unique) == len(forward) and np.array_equal(unique, np.unique(backward))

    def _face_cross_products(self) -> Float[np.ndarray, "f 3"]:
        a, b, c = (self.vertices[self.faces[:, corner]] for corner in range(3))
        return np.cross(b - a, c - a)


def area_weighted_vertex_normals(vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"]) -> Float[Tensor, "v 3"]:
    """Return unit vertex normals of posed vertices as a tensor; the tensor version of `Mesh.vertex_normals`."""
    corners = vertices[faces.long()]
    cross = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    summed = torch.zeros_like(vertices).index_add_(0, faces.long().reshape(-1), cross.repeat_interleave(3, dim=0))
    return torch.nn.functional.normalize(summed, dim=1)
