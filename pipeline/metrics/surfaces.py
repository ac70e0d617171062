"""Geometry against ground truth: surface distances in mm, angles between normals in degrees, joint errors in m.

These functions do not align the surfaces; the caller aligns them first where that is wanted, see
`pipeline.metrics.alignment`.
"""

import numpy as np
from jaxtyping import Float, Int

from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import closest_points_on_mesh


def sample_surface(mesh: Mesh, count: int, seed: int = 0) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "n"]]:
    """Sample points (m, float64) uniformly by area; return the points and the face of each point.

    Args:
        mesh: the surface, m.
        count: number of points n.
        seed: seed of the samples; the same seed gives the same points.

    Raises:
        ValueError: the mesh has no area.
    """
    generator = np.random.default_rng(seed)
    areas_m2 = mesh.face_areas_m2()
    if not len(areas_m2) or areas_m2.sum() <= 0.0:
        raise ValueError("the mesh has no area: no point can be sampled")
    faces = generator.choice(len(areas_m2), size=count, p=areas_m2 / areas_m2.sum())
    root, v = np.sqrt(generator.random((count, 1))), generator.random((count, 1))
    a, b, c = (mesh.vertices[mesh.faces[faces, corner]].astype(np.float64) for corner in range(3))
    return (1.0 - root) * a + root * (1.0 - v) * b + root * v * c, faces


def surface_scores(
    result: Mesh, truth: Mesh, count: int = 100_000, threshold_m: float = 0.005, seed: int = 0
) -> dict[str, float]:
    """Return the distances between two surfaces.

    Points are sampled on each surface by area; each is compared with the closest point of the other surface.

    Args:
        result, truth: the surfaces, m.
        count: sample points per surface.
        threshold_m: distance threshold of precision, recall and F-score.
        seed: seed of the samples.

    Returns:
        result_to_truth_mm, truth_to_result_mm: mean distances; chamfer_mm: their mean.
        hausdorff95_mm: the larger of the two 95th percentiles.
        precision, recall: fractions of the points of result and truth within the threshold, in [0, 1].
        f_score: harmonic mean of precision and recall, in [0, 1].
        normal_angle_deg: mean angle between the normals at corresponding points, over both directions.

    Raises:
        ValueError: a surface has no area.
    """
    forward_m, forward_deg = _one_sided_distances(result, truth, count, seed)
    backward_m, backward_deg = _one_sided_distances(truth, result, count, seed + 1)
    precision, recall = float(np.mean(forward_m <= threshold_m)), float(np.mean(backward_m <= threshold_m))
    return {
        "result_to_truth_mm": 1000.0 * float(forward_m.mean()),
        "truth_to_result_mm": 1000.0 * float(backward_m.mean()),
        "chamfer_mm": 500.0 * float(forward_m.mean() + backward_m.mean()),
        "hausdorff95_mm": 1000.0 * float(max(np.percentile(forward_m, 95), np.percentile(backward_m, 95))),
        "precision": precision,
        "recall": recall,
        "f_score": 2.0 * precision * recall / (precision + recall) if precision + recall > 0.0 else 0.0,
        "normal_angle_deg": 0.5 * float(forward_deg.mean() + backward_deg.mean()),
    }


def mpjpe_m(joints_m: Float[np.ndarray, "*n 3"], truth_m: Float[np.ndarray, "*n 3"]) -> float:
    """Return the mean per-joint position error (MPJPE) in metres, without alignment."""
    return float(np.linalg.norm(joints_m - truth_m, axis=-1).mean())


def _one_sided_distances(
    source: Mesh, target: Mesh, count: int, seed: int
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Return distances (m) and normal angles (degrees) of samples on `source` to their closest points on `target`."""
    points, source_faces = sample_surface(source, count, seed)
    distances_m, target_faces, _ = closest_points_on_mesh(points, target)
    cosines = np.sum(source.face_normals()[source_faces] * target.face_normals()[target_faces], axis=1)
    return distances_m, np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))
