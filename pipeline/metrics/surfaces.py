"""Geometry against truth: distances between surfaces in millimetres, normals in degrees, joints in metres.

Nothing is aligned here: both surfaces are compared where they lie, and the caller says which alignment it made before.
"""

import numpy as np
from jaxtyping import Float, Int

from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import closest_points_on_mesh


def sample_surface(mesh: Mesh, count: int, seed: int = 0) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "n"]]:
    """Points spread evenly by area (float64), and the face of each. Deterministic in the seed."""
    generator = np.random.default_rng(seed)
    areas_m2 = mesh.face_areas_m2()
    if not len(areas_m2) or areas_m2.sum() <= 0.0:
        raise ValueError("the mesh has no area to sample")
    faces = generator.choice(len(areas_m2), size=count, p=areas_m2 / areas_m2.sum())
    root, v = np.sqrt(generator.random((count, 1))), generator.random((count, 1))
    a, b, c = (mesh.vertices[mesh.faces[faces, corner]].astype(np.float64) for corner in range(3))
    return (1.0 - root) * a + root * (1.0 - v) * b + root * v * c, faces


def surface_scores(
    result: Mesh, truth: Mesh, count: int = 100_000, threshold_m: float = 0.005, seed: int = 0
) -> dict[str, float]:
    """How far two surfaces are apart.

    Points are sampled on each surface by area and measured to the other surface's nearest triangle.

    Returns:
        result_to_truth_mm, truth_to_result_mm: mean distances; chamfer_mm: their mean.
        hausdorff95_mm: the larger of the two 95th percentiles.
        precision, recall, f_score: shares within the threshold, and their harmonic mean, in [0, 1].
        normal_angle_deg: mean angle between the normals at corresponding points, both ways.
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
    """Mean distance of corresponding joints, without any alignment (MPJPE)."""
    return float(np.linalg.norm(joints_m - truth_m, axis=-1).mean())


def _one_sided_distances(
    source: Mesh, target: Mesh, count: int, seed: int
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Distances (m) and normal angles (degrees) of points on `source` to their nearest place on `target`."""
    points, source_faces = sample_surface(source, count, seed)
    distances_m, target_faces, _ = closest_points_on_mesh(points, target)
    cosines = np.sum(source.face_normals()[source_faces] * target.face_normals()[target_faces], axis=1)
    return distances_m, np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))
