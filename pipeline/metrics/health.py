"""Quality of a triangle mesh: closed, manifold, connected, well shaped, without self-intersections."""

import igl
import numpy as np
from jaxtyping import Float

from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import count_self_intersecting_faces

SLIVER_ANGLE_DEG = 10.0


def mesh_quality_metrics(mesh: Mesh) -> dict[str, float | int | bool]:
    """Return the mesh metrics of the report.

    Returns:
        vertices, faces: counts.
        watertight: every directed edge has exactly one opposite edge, see `Mesh.is_watertight`.
        manifold: see `is_manifold`.
        components: number of connected components, see `component_count`.
        sliver_fraction: fraction of faces with an angle below 10 degrees, in [0, 1].
        min_angle_deg: smallest angle of any face.
        self_intersecting_faces: number of faces that intersect another face.
    """
    min_angles_deg = min_face_angles_deg(mesh)
    return {
        "vertices": len(mesh.vertices),
        "faces": len(mesh.faces),
        "watertight": mesh.is_watertight(),
        "manifold": is_manifold(mesh),
        "components": component_count(mesh),
        "sliver_fraction": float(np.mean(min_angles_deg < SLIVER_ANGLE_DEG)),
        "min_angle_deg": float(min_angles_deg.min()),
        "self_intersecting_faces": count_self_intersecting_faces(mesh),
    }


def is_manifold(mesh: Mesh) -> bool:
    """Return whether each edge has at most two faces, consistently wound, and each vertex one fan of faces.

    Vertices without faces are ignored; a mesh without faces is not manifold.
    """
    if len(mesh.faces) == 0:
        return False
    faces = mesh.faces.astype(np.int64)
    return bool(igl.is_edge_manifold(faces)[0] and igl.is_vertex_manifold(faces)[np.unique(faces)].all())


def component_count(mesh: Mesh) -> int:
    """Return the number of pieces that are connected through shared vertices; vertices without faces do not count."""
    component_of_vertex = igl.vertex_components(mesh.faces.astype(np.int64))
    return len(np.unique(component_of_vertex[mesh.faces[:, 0]]))


def min_face_angles_deg(mesh: Mesh) -> Float[np.ndarray, "f"]:
    """Return the smallest interior angle of each face in degrees; 0 for faces without area."""
    angles_rad = igl.internal_angles(mesh.vertices.astype(np.float64), mesh.faces.astype(np.int64))
    # Two coincident corners have no defined angles: NaN.
    return np.degrees(np.nan_to_num(angles_rad, nan=0.0).min(axis=1))
