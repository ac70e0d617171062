"""Laying one surface over another, so that shape is compared and not place."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import MeshAABBTree
from pipeline.metrics.surfaces import sample_surface

CONVERGENCE_M = 2e-5
"""An alignment that moves no point farther than this in a round is finished."""


@dataclass(frozen=True)
class SimilarityTransform:
    """x -> scale * rotation @ x + shift_m."""

    scale: float
    rotation: Float[np.ndarray, "3 3"]
    translation_m: Float[np.ndarray, "3"]

    def __call__(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Moved points, float64."""
        return self.scale * points.astype(np.float64) @ self.rotation.T + self.translation_m

    def inverse(self) -> "SimilarityTransform":
        """The way back."""
        rotation = self.rotation.T
        return SimilarityTransform(1.0 / self.scale, rotation, -rotation @ self.translation_m / self.scale)

    def moved(self, mesh: Mesh) -> Mesh:
        """The mesh with its vertices moved."""
        return Mesh(self(mesh.vertices), mesh.faces)


def umeyama_similarity(
    points: Float[np.ndarray, "n 3"], targets: Float[np.ndarray, "n 3"], with_scale: bool = True
) -> SimilarityTransform:
    """The similarity (or, without scale, the rigid motion) that takes points to their targets with the least squared
    error. Umeyama, "Least-squares estimation of transformation parameters between two point patterns", 1991.
    """
    centroid, target_centroid = points.mean(axis=0), targets.mean(axis=0)
    covariance = (targets - target_centroid).T @ (points - centroid) / len(points)
    left, singular, right = np.linalg.svd(covariance)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(left) * np.linalg.det(right))])
    rotation = (left * signs) @ right
    source_variance = float(((points - centroid) ** 2).sum(axis=1).mean())
    scale = float((singular * signs).sum()) / source_variance if with_scale else 1.0
    return SimilarityTransform(scale, rotation, target_centroid - scale * rotation @ centroid)


def align_surfaces_icp(
    source: Mesh, target: Mesh, with_scale: bool = True, rounds: int = 30, count: int = 3000, seed: int = 0
) -> SimilarityTransform:
    """What takes `source` onto `target`: iterated closest points, both ways so that shrinking does not pay.

    Starts with the middles (and sizes, with scale) of the two surfaces laid over each other and no rotation: they have
    to be turned alike within some 30 degrees already. Deterministic in the seed.
    """
    points, _ = sample_surface(source, count, seed)
    targets, _ = sample_surface(target, count, seed + 1)
    start_scale = float(np.sqrt(targets.var(axis=0).sum() / points.var(axis=0).sum())) if with_scale else 1.0
    similarity = SimilarityTransform(start_scale, np.eye(3), targets.mean(axis=0) - start_scale * points.mean(axis=0))
    source_tree, target_tree = MeshAABBTree(source), MeshAABBTree(target)
    for _ in range(rounds):
        before = similarity(points)
        sources = np.concatenate([points, source_tree.nearest(similarity.inverse()(targets))])
        similarity = umeyama_similarity(sources, np.concatenate([target_tree.nearest(before), targets]), with_scale)
        if np.abs(similarity(points) - before).max() < CONVERGENCE_M:
            break
    return similarity
