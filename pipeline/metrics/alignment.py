"""Laying one surface over another, so that shape is compared and not place."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import SurfaceTree
from pipeline.metrics.surfaces import sample_surface

SETTLED_M = 2e-5
"""An alignment that moves no point farther than this in a round is finished."""


@dataclass(frozen=True)
class Similarity:
    """x -> scale * rotation @ x + shift_m."""

    scale: float
    rotation: Float[np.ndarray, "3 3"]
    shift_m: Float[np.ndarray, "3"]

    def __call__(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Moved points, float64."""
        return self.scale * points.astype(np.float64) @ self.rotation.T + self.shift_m

    def inverse(self) -> "Similarity":
        """The way back."""
        rotation = self.rotation.T
        return Similarity(1.0 / self.scale, rotation, -rotation @ self.shift_m / self.scale)

    def moved(self, mesh: Mesh) -> Mesh:
        """The mesh with its vertices moved."""
        return Mesh(self(mesh.vertices), mesh.faces)


def similarity_between(
    points: Float[np.ndarray, "n 3"], targets: Float[np.ndarray, "n 3"], with_scale: bool = True
) -> Similarity:
    """The similarity (or, without scale, the rigid motion) that takes points to their targets with the least squared
    error. Umeyama, "Least-squares estimation of transformation parameters between two point patterns", 1991.
    """
    middle, target_middle = points.mean(axis=0), targets.mean(axis=0)
    covariance = (targets - target_middle).T @ (points - middle) / len(points)
    left, singular, right = np.linalg.svd(covariance)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(left) * np.linalg.det(right))])
    rotation = (left * signs) @ right
    spread = float(((points - middle) ** 2).sum(axis=1).mean())
    scale = float((singular * signs).sum()) / spread if with_scale else 1.0
    return Similarity(scale, rotation, target_middle - scale * rotation @ middle)


def align_surfaces(
    source: Mesh, target: Mesh, with_scale: bool = True, rounds: int = 30, count: int = 3000, seed: int = 0
) -> Similarity:
    """What takes `source` onto `target`: iterated closest points, both ways so that shrinking does not pay.

    Starts with the middles (and sizes, with scale) of the two surfaces laid over each other and no rotation: they have
    to be turned alike within some 30 degrees already. Deterministic in the seed.
    """
    points, _ = sample_surface(source, count, seed)
    targets, _ = sample_surface(target, count, seed + 1)
    start_scale = float(np.sqrt(targets.var(axis=0).sum() / points.var(axis=0).sum())) if with_scale else 1.0
    found = Similarity(start_scale, np.eye(3), targets.mean(axis=0) - start_scale * points.mean(axis=0))
    source_tree, target_tree = SurfaceTree(source), SurfaceTree(target)
    for _ in range(rounds):
        before = found(points)
        sources = np.concatenate([points, source_tree.nearest(found.inverse()(targets))])
        found = similarity_between(sources, np.concatenate([target_tree.nearest(before), targets]), with_scale)
        if np.abs(found(points) - before).max() < SETTLED_M:
            break
    return found
