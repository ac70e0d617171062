"""Is a triangle mesh sound: closed, manifold, in one piece, well shaped, free of self-intersections?"""

import numpy as np
import pymeshlab
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pipeline.geometry.mesh import Mesh

SLIVER_ANGLE_DEG = 10.0


def mesh_health(mesh: Mesh) -> dict[str, float | int | bool]:
    """Everything that the report says about a mesh.

    Returns:
        vertices, faces: counts. watertight, manifold: see the functions below. components: pieces joined by edges.
        sliver_share: share of faces whose smallest angle is below 10 degrees; smallest_angle_deg: over all faces.
        self_intersecting_faces: faces that cut another face.
    """
    smallest_deg = smallest_angles_deg(mesh)
    return {
        "vertices": len(mesh.vertices),
        "faces": len(mesh.faces),
        "watertight": mesh.is_watertight(),
        "manifold": is_manifold(mesh),
        "components": component_count(mesh),
        "sliver_share": float(np.mean(smallest_deg < SLIVER_ANGLE_DEG)),
        "smallest_angle_deg": float(smallest_deg.min()),
        "self_intersecting_faces": self_intersecting_faces(mesh),
    }


def is_manifold(mesh: Mesh) -> bool:
    """At most two faces meet at each edge, and the faces around each vertex form one fan.

    Face corners are the nodes of a graph; two corners at the same vertex are joined when their faces share an edge at
    that vertex. One fan a vertex means as many connected parts as there are vertices in use.
    """
    if len(mesh.faces) == 0 or int(mesh.edge_face_counts().max()) > 2:
        return False
    face_count = len(mesh.faces)
    corners = np.arange(3 * face_count).reshape(face_count, 3)
    starts = np.concatenate([mesh.faces[:, k] for k in range(3)])
    ends = np.concatenate([mesh.faces[:, (k + 1) % 3] for k in range(3)])
    start_corners = np.concatenate([corners[:, k] for k in range(3)])
    end_corners = np.concatenate([corners[:, (k + 1) % 3] for k in range(3)])
    flipped = starts > ends
    low_corners = np.where(flipped, end_corners, start_corners)
    high_corners = np.where(flipped, start_corners, end_corners)
    order = np.lexsort((np.maximum(starts, ends), np.minimum(starts, ends)))
    low, high = np.minimum(starts, ends)[order], np.maximum(starts, ends)[order]
    twins = np.flatnonzero((low[1:] == low[:-1]) & (high[1:] == high[:-1]))
    pairs = np.concatenate(
        [np.stack([ordered[twins], ordered[twins + 1]]) for ordered in (low_corners[order], high_corners[order])],
        axis=1,
    )
    return _part_count(pairs, 3 * face_count) == len(np.unique(mesh.faces))


def component_count(mesh: Mesh) -> int:
    """Pieces that are connected through edges; vertices without faces do not count."""
    used, flat = np.unique(mesh.faces, return_inverse=True)
    faces = flat.reshape(-1, 3)
    pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]]).T
    return _part_count(pairs, len(used))


def smallest_angles_deg(mesh: Mesh) -> Float[np.ndarray, "f"]:
    """Smallest inner angle of each face; 0 for faces without area."""
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    angles = []
    for corner in range(3):
        a = corners[:, (corner + 1) % 3] - corners[:, corner]
        b = corners[:, (corner + 2) % 3] - corners[:, corner]
        angles.append(np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.sum(a * b, axis=1)))
    return np.degrees(np.min(angles, axis=0))


def self_intersecting_faces(mesh: Mesh) -> int:
    """Number of faces that cut through another face (VCGlib, through pymeshlab)."""
    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(mesh.vertices.astype(np.float64), mesh.faces.astype(np.int32)))
    meshes.compute_selection_by_self_intersections_per_face()
    return int(meshes.current_mesh().selected_face_number())


def _part_count(pairs: Int[np.ndarray, "2 e"], node_count: int) -> int:
    graph = coo_array((np.ones(pairs.shape[1], dtype=bool), (pairs[0], pairs[1])), shape=(node_count, node_count))
    return int(connected_components(graph, directed=False)[0])
