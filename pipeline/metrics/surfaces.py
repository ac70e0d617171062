"""Geometry against ground truth: surface distances in mm, angles between normals in degrees, joint errors in m.

These functions do not align the surfaces; the caller aligns them first where that is wanted, see
`pipeline.metrics.alignment`.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import closest_points_on_mesh
from pipeline.metrics.agreeing_faces import nearest_agreeing_faces

NORMAL_REACH_M = 0.03
"""Normals are compared with faces of the other surface within this distance."""

FAR_DISTANCE_M = 0.03
"""Area of the result farther than this from the truth counts as far."""


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


@dataclass(frozen=True)
class SurfaceCorrespondence:
    """Points sampled on two surfaces by area, each with the closest point of the other surface.

    Attributes:
        result_m, truth_m: distance of the points of the result to the truth, and of the truth to the result, m.
        result_deg, truth_deg: angle between the normal at each point and that of the other surface, see
            `surface_correspondence`, in [0, 90] degrees.
        result_face: face of the truth closest to each point of the result.
        truth_face: face of the truth that contains each point of the truth.
    """

    result_m: Float[np.ndarray, "n"]
    truth_m: Float[np.ndarray, "n"]
    result_deg: Float[np.ndarray, "n"]
    truth_deg: Float[np.ndarray, "n"]
    result_face: Int[np.ndarray, "n"]
    truth_face: Int[np.ndarray, "n"]

    def scores(self, threshold_m: float = 0.005) -> dict[str, float]:
        """Return the scores of `surface_scores`."""
        precision, recall = float(np.mean(self.result_m <= threshold_m)), float(np.mean(self.truth_m <= threshold_m))
        return {
            "result_to_truth_mm": 1000.0 * float(self.result_m.mean()),
            "truth_to_result_mm": 1000.0 * float(self.truth_m.mean()),
            "chamfer_mm": 500.0 * float(self.result_m.mean() + self.truth_m.mean()),
            "hausdorff95_mm": 1000.0 * float(max(np.percentile(self.result_m, 95), np.percentile(self.truth_m, 95))),
            "precision": precision,
            "recall": recall,
            "f_score": 2.0 * precision * recall / (precision + recall) if precision + recall > 0.0 else 0.0,
            "normal_angle_deg": 0.5 * float(self.result_deg.mean() + self.truth_deg.mean()),
            "far_area_share": float(np.mean(self.result_m > FAR_DISTANCE_M)),
        }

    def label_scores(self, face_label: Int[np.ndarray, "f"], label: int) -> dict[str, float] | None:
        """Return the scores of one part of the truth: both means over the points that correspond to its faces.

        Args:
            face_label: label of each face of the truth.
            label: of the part.

        Returns:
            chamfer_mm, normal_angle_deg, and area_share (fraction of the truth's points that are on the part). None if
            no point of the truth is on it. Where no point of the result is closest to it, the truth's direction counts.
        """
        on_truth, on_result = face_label[self.truth_face] == label, face_label[self.result_face] == label
        if not on_truth.any():
            return None
        distances_m, angles_deg = [self.truth_m[on_truth].mean()], [self.truth_deg[on_truth].mean()]
        if on_result.any():
            distances_m.append(self.result_m[on_result].mean())
            angles_deg.append(self.result_deg[on_result].mean())
        return {
            "chamfer_mm": 1000.0 * float(np.mean(distances_m)),
            "normal_angle_deg": float(np.mean(angles_deg)),
            "area_share": float(on_truth.mean()),
        }


def surface_correspondence(result: Mesh, truth: Mesh, count: int = 100_000, seed: int = 0) -> SurfaceCorrespondence:
    """Sample both surfaces and find the corresponding points.

    Distances are to the closest point of the other surface. The angle is to the nearest face of the other surface that
    lies within `NORMAL_REACH_M` and whose normal is less than 90 degrees away, so that inner layers and back sides do
    not count; where there is none, it is 90 degrees.

    Args:
        result, truth: the surfaces as seen from outside, m.
        count: sample points per surface.
        seed: seed of the samples.

    Raises:
        ValueError: a surface has no area.
    """
    points, faces = sample_surface(result, count, seed)
    result_m, result_face, _ = closest_points_on_mesh(points, truth)
    true_points, true_faces = sample_surface(truth, count, seed + 1)
    truth_m, _, _ = closest_points_on_mesh(true_points, result)
    return SurfaceCorrespondence(
        result_m=result_m,
        truth_m=truth_m,
        result_deg=_normal_angles_deg(points, result.face_normals()[faces], truth),
        truth_deg=_normal_angles_deg(true_points, truth.face_normals()[true_faces], result),
        result_face=result_face,
        truth_face=true_faces,
    )


def surface_scores(
    result: Mesh, truth: Mesh, count: int = 100_000, threshold_m: float = 0.005, seed: int = 0
) -> dict[str, float]:
    """Return the distances between two surfaces.

    Points are sampled on each surface by area; each is compared with the closest point of the other surface.

    Args:
        result, truth: the surfaces as seen from outside, m.
        count: sample points per surface.
        threshold_m: distance threshold of precision, recall and F-score.
        seed: seed of the samples.

    Returns:
        result_to_truth_mm, truth_to_result_mm: mean distances; chamfer_mm: their mean.
        hausdorff95_mm: the larger of the two 95th percentiles.
        precision, recall: fractions of the points of result and truth within the threshold, in [0, 1].
        f_score: harmonic mean of precision and recall, in [0, 1].
        normal_angle_deg: mean angle between the normals of `surface_correspondence`, over both directions.
        far_area_share: fraction of the result's area that is farther than `FAR_DISTANCE_M` from the truth, in [0, 1].

    Raises:
        ValueError: a surface has no area.
    """
    return surface_correspondence(result, truth, count, seed).scores(threshold_m)


def chamfer_distance_mm(result: Mesh, truth: Mesh, count: int = 100_000, seed: int = 0) -> float:
    """Return the Chamfer distance, `chamfer_mm` of `surface_scores`, alone."""
    forward_m, _, _ = closest_points_on_mesh(sample_surface(result, count, seed)[0], truth)
    backward_m, _, _ = closest_points_on_mesh(sample_surface(truth, count, seed + 1)[0], result)
    return 500.0 * float(forward_m.mean() + backward_m.mean())


def mpjpe_m(joints_m: Float[np.ndarray, "*n 3"], truth_m: Float[np.ndarray, "*n 3"]) -> float:
    """Return the mean per-joint position error (MPJPE) in metres, without alignment."""
    return float(np.linalg.norm(joints_m - truth_m, axis=-1).mean())


def _normal_angles_deg(
    points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], target: Mesh
) -> Float[np.ndarray, "n"]:
    """Return the angles (degrees) between normals at points and the nearest agreeing faces of `target`; 90 if none."""
    _, faces = nearest_agreeing_faces(points, normals, target, NORMAL_REACH_M)
    cosines = np.sum(normals * target.face_normals()[faces], axis=1)
    return np.where(faces >= 0, np.degrees(np.arccos(np.clip(cosines, 0.0, 1.0))), 90.0)
