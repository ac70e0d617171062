"""The one triangle mesh of the house: arrays, and what follows from them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int


@dataclass(frozen=True)
class Mesh:
    """Triangles in metres; faces are counter-clockwise seen from outside."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]

    def face_normals(self) -> Float[np.ndarray, "f 3"]:
        """Unit normals; zero for faces without area."""
        cross = self._face_cross_products()
        return cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-20)

    def face_areas_m2(self) -> Float[np.ndarray, "f"]:
        """Area of each face, square metres."""
        return 0.5 * np.linalg.norm(self._face_cross_products(), axis=1)

    def vertex_normals(self) -> Float[np.ndarray, "v 3"]:
        """Area-weighted unit normals; zero at vertices without faces."""
        cross = self._face_cross_products()
        normals = np.zeros((len(self.vertices), 3))
        for corner in range(3):
            for axis in range(3):
                normals[:, axis] += np.bincount(self.faces[:, corner], cross[:, axis], minlength=len(self.vertices))
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)
        return normals.astype(self.vertices.dtype)

    def edges(self) -> Int[np.ndarray, "e 2"]:
        """Undirected edges, once each, smaller index first, sorted."""
        return np.unique(self._undirected_half_edges(), axis=0)

    def edge_face_counts(self) -> Int[np.ndarray, "e"]:
        """How many faces meet at each of `edges()`."""
        return np.unique(self._undirected_half_edges(), axis=0, return_counts=True)[1]

    def is_watertight(self) -> bool:
        """Closed, edge-manifold and consistently wound: every directed edge has exactly one partner."""
        half_edges = np.concatenate([self.faces[:, [0, 1]], self.faces[:, [1, 2]], self.faces[:, [2, 0]]])
        forward = half_edges[:, 0].astype(np.int64) * len(self.vertices) + half_edges[:, 1]
        backward = half_edges[:, 1].astype(np.int64) * len(self.vertices) + half_edges[:, 0]
        unique = np.unique(forward)
        return len(half_edges) > 0 and len(unique) == len(forward) and np.array_equal(unique, np.unique(backward))

    def _face_cross_products(self) -> Float[np.ndarray, "f 3"]:
        a, b, c = (self.vertices[self.faces[:, corner]] for corner in range(3))
        return np.cross(b - a, c - a)

    def _undirected_half_edges(self) -> Int[np.ndarray, "h 2"]:
        half_edges = np.concatenate([self.faces[:, [0, 1]], self.faces[:, [1, 2]], self.faces[:, [2, 0]]])
        return np.sort(half_edges, axis=1)
