"""Similarity transforms, and the one between corresponding points with the least squared error."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.geometry.mesh import Mesh


@dataclass(frozen=True)
class SimilarityTransform:
    """The transform x -> scale * rotation @ x + translation_m."""

    scale: float
    rotation: Float[np.ndarray, "3 3"]
    translation_m: Float[np.ndarray, "3"]

    def __call__(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Transform points (m); the result is float64."""
        return self.scale * points.astype(np.float64) @ self.rotation.T + self.translation_m

    def inverse(self) -> "SimilarityTransform":
        """Return the inverse transform."""
        rotation = self.rotation.T
        return SimilarityTransform(1.0 / self.scale, rotation, -rotation @ self.translation_m / self.scale)

    def transform_mesh(self, mesh: Mesh) -> Mesh:
        """Return the mesh with transformed vertices (float64)."""
        return Mesh(self(mesh.vertices), mesh.faces)


def fit_similarity(
    points: Float[np.ndarray, "n 3"], targets: Float[np.ndarray, "n 3"], with_scale: bool = True
) -> SimilarityTransform:
    """Return the transform of `points` to their corresponding `targets` with the least squared error.

    Source: Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI 1991.

    Args:
        points: at least three points that do not lie on one line, m.
        targets: the corresponding positions, m.
        with_scale: estimate the scale; otherwise the scale is 1 (a rigid transform).
    """
    points, targets = points.astype(np.float64), targets.astype(np.float64)
    centroid, target_centroid = points.mean(axis=0), targets.mean(axis=0)
    centred = points - centroid
    left, singular, right = np.linalg.svd((targets - target_centroid).T @ centred)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(left) * np.linalg.det(right))])
    rotation = (left * signs) @ right
    scale = float((singular * signs).sum() / np.sum(centred**2)) if with_scale else 1.0
    return SimilarityTransform(scale, rotation, target_centroid - scale * rotation @ centroid)
