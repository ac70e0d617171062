"""Is a triangle mesh sound: closed, manifold, in one piece, well shaped, free of self-intersections?"""

import numpy as np
from jaxtyping import Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import self_intersecting_faces, split_nonmanifold_vertices

SLIVER_ANGLE_DEG = 10.0


def mesh_quality_metrics(mesh: Mesh) -> dict[str, float | int | bool]:
    """Everything that the report says about a mesh.

    Returns:
        vertices, faces: counts. watertight, manifold: see the functions below. components: pieces joined by edges.
        sliver_share: share of faces whose smallest angle is below 10 degrees; smallest_angle_deg: over all faces.
        self_intersecting_faces: faces that cut another face.
    """
    smallest_deg = min_face_angles_deg(mesh)
    return {
        "vertices": len(mesh.vertices),
        "faces": len(mesh.faces),
        "watertight": mesh.is_watertight(),
        "manifold": is_manifold(mesh),
        "components": component_count(mesh),
        "sliver_fraction": float(np.mean(smallest_deg < SLIVER_ANGLE_DEG)),
        "min_angle_deg": float(smallest_deg.min()),
        "self_intersecting_faces": self_intersecting_faces(mesh),
    }


def is_manifold(mesh: Mesh) -> bool:
    """At most two faces meet at each edge, and the faces around each vertex form one fan."""
    if len(mesh.faces) == 0 or int(mesh.edge_face_counts().max()) > 2:
        return False
    return split_nonmanifold_vertices(mesh) is mesh


def component_count(mesh: Mesh) -> int:
    """Pieces that are connected through edges; vertices without faces do not count."""
    used, flat = np.unique(mesh.faces, return_inverse=True)
    faces = flat.reshape(-1, 3)
    pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]]).T
    graph = coo_array((np.ones(pairs.shape[1], dtype=bool), (pairs[0], pairs[1])), shape=(len(used), len(used)))
    return int(connected_components(graph, directed=False)[0])


def min_face_angles_deg(mesh: Mesh) -> Float[np.ndarray, "f"]:
    """Smallest inner angle of each face; 0 for faces without area."""
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    angles = []
    for corner in range(3):
        a = corners[:, (corner + 1) % 3] - corners[:, corner]
        b = corners[:, (corner + 2) % 3] - corners[:, corner]
        angles.append(np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.sum(a * b, axis=1)))
    return np.degrees(np.min(angles, axis=0))
