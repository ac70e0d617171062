"""Alignment of one surface to another, so that shapes are compared independently of pose and scale.

Reference: Besl and McKay, "A method for registration of 3-D shapes", PAMI 1992 (iterative closest points, ICP).
"""

import numpy as np

from pipeline.geometry.mesh import Mesh
from pipeline.geometry.similarity import SimilarityTransform, fit_similarity
from pipeline.geometry.surface import MeshAABBTree
from pipeline.metrics.surfaces import sample_surface

CONVERGENCE_M = 2e-5
"""ICP ends when no coordinate of any sample moves by this distance or more in one iteration."""


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
        similarity = fit_similarity(sources, destinations, with_scale)
        if np.abs(similarity(points) - before).max() < CONVERGENCE_M:
            break
    return similarity
