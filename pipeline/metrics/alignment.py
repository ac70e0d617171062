"""Alignment of one surface to another, so that shapes are compared independently of pose and scale.

References: Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI 1991;
Besl and McKay, "A method for registration of 3-D shapes", PAMI 1992 (iterative closest points, ICP).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import MeshAABBTree
from pipeline.metrics.surfaces import sample_surface

CONVERGENCE_M = 2e-5
"""ICP ends when no coordinate of any sample moves by this distance or more in one iteration."""


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


def umeyama_similarity(
    points: Float[np.ndarray, "n 3"], targets: Float[np.ndarray, "n 3"], with_scale: bool = True
) -> SimilarityTransform:
    """Return the transform of `points` to their corresponding `targets` with the least squared error (Umeyama 1991).

    Args:
        points: at least three points that do not lie on one line, m.
        targets: the corresponding positions, m.
        with_scale: estimate the scale; otherwise the scale is 1 (a rigid transform).
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
    source: Mesh, target: Mesh, with_scale: bool = True, max_iterations: int = 30, count: int = 3000, seed: int = 0
) -> SimilarityTransform:
    """Align `source` to `target` by ICP with correspondences in both directions.

    Correspondences in one direction alone would let the scale shrink. The initial transform aligns the centroids (and
    the sizes, with scale) without rotation, so the surfaces must already have the same orientation within about 30
    degrees. The result is deterministic for a given seed.

    Args:
        source, target: surfaces, m.
        with_scale: estimate the scale; otherwise the transform is rigid.
        max_iterations: iterations at most; `CONVERGENCE_M` ends them earlier.
        count: sample points per surface.
        seed: seed of the samples.
    """
    points, _ = sample_surface(source, count, seed)
    targets, _ = sample_surface(target, count, seed + 1)
    initial_scale = float(np.sqrt(targets.var(axis=0).sum() / points.var(axis=0).sum())) if with_scale else 1.0
    initial_translation_m = targets.mean(axis=0) - initial_scale * points.mean(axis=0)
    similarity = SimilarityTransform(initial_scale, np.eye(3), initial_translation_m)
    source_tree, target_tree = MeshAABBTree(source), MeshAABBTree(target)
    for _ in range(max_iterations):
        before = similarity(points)
        sources = np.concatenate([points, source_tree.closest_points(similarity.inverse()(targets))])
        destinations = np.concatenate([target_tree.closest_points(before), targets])
        similarity = umeyama_similarity(sources, destinations, with_scale)
        if np.abs(similarity(points) - before).max() < CONVERGENCE_M:
            break
    return similarity
