"""The face of a surface that corresponds to a point with a normal: the nearest one that faces the same way.

The nearest face alone may be an inner layer or the back of a thin part, whose normal says nothing about the error of
the surface. The search is exact: a tree of boxes gives the nearest face of all; where that face disagrees, all faces
whose bounding sphere is within reach are tested, found by trees of sphere centres, one tree for each octave of radii.
"""

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import closest_points_on_mesh

_CHUNK_POINTS = 512
"""Points whose candidates are tested at once; bounds the memory."""


def nearest_agreeing_faces(
    points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], mesh: Mesh, reach_m: float
) -> tuple[Float[np.ndarray, "n"], Int[np.ndarray, "n"]]:
    """Return distance (m) and index of the nearest face whose normal is less than 90 degrees from that of each point.

    Args:
        points: m.
        normals: of the points, any length.
        mesh: the surface; a face without area agrees with no normal.
        reach_m: faces at a greater distance are ignored.

    Returns:
        Distance, inf where no face qualifies; face, -1 there.
    """
    nearest_m, nearest_face, _ = closest_points_on_mesh(points, mesh)
    face_normals = mesh.face_normals()
    agrees = np.sum(normals * face_normals[nearest_face], axis=1) > 0.0
    within = nearest_m <= reach_m
    distance_m = np.where(agrees & within, nearest_m, np.inf)
    face = np.where(agrees & within, nearest_face, -1)
    open_rows = np.flatnonzero(~agrees & within)
    if len(open_rows):
        candidates = _FaceBalls(mesh)
        for rows in np.array_split(open_rows, -(-len(open_rows) // _CHUNK_POINTS)):
            row, candidate = candidates.near(points[rows], reach_m)
            agreeing = np.sum(normals[rows[row]] * face_normals[candidate], axis=1) > 0.0
            row, candidate = row[agreeing], candidate[agreeing]
            triangles = mesh.vertices[mesh.faces[candidate]].astype(np.float64)
            apart_m = point_triangle_distances_m(points[rows[row]].astype(np.float64), triangles)
            order = np.lexsort((candidate, apart_m, row))  # ties: the lower index
            order = order[apart_m[order] <= reach_m]
            found, first = np.unique(row[order], return_index=True)
            distance_m[rows[found]], face[rows[found]] = apart_m[order[first]], candidate[order[first]]
    return distance_m, face


def point_triangle_distances_m(
    points: Float[np.ndarray, "n 3"], triangles: Float[np.ndarray, "n 3 3"]
) -> Float[np.ndarray, "n"]:
    """Return the distance of each point to its triangle, m; a triangle may be a segment or a point."""
    squared = np.full(len(points), np.inf)
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    above = np.ones(len(points), dtype=bool)  # the foot of the perpendicular is inside the triangle
    for corner in range(3):
        start, edge = triangles[:, corner], triangles[:, (corner + 1) % 3] - triangles[:, corner]
        offset = points - start
        along = np.sum(offset * edge, axis=1) / np.maximum(np.sum(edge * edge, axis=1), 1e-30)
        to_edge = offset - np.clip(along, 0.0, 1.0)[:, None] * edge
        squared = np.minimum(squared, np.sum(to_edge**2, axis=1))
        above &= np.sum(np.cross(edge, offset) * normal, axis=1) >= 0.0
    normal_squared = np.sum(normal**2, axis=1)
    height_squared = np.sum((points - triangles[:, 0]) * normal, axis=1) ** 2 / np.maximum(normal_squared, 1e-30)
    squared = np.where(above & (normal_squared > 1e-30), height_squared, squared)
    return np.sqrt(squared)


class _FaceBalls:
    """Bounding spheres of all faces around their centroids, in one tree for each octave of radii."""

    def __init__(self, mesh: Mesh) -> None:
        corners = mesh.vertices[mesh.faces].astype(np.float64)
        centres = corners.mean(axis=1)
        radii_m = np.linalg.norm(corners - centres[:, None], axis=2).max(axis=1)
        octaves = np.floor(np.log2(np.maximum(radii_m, 1e-6))).astype(np.int64)
        self._groups = []
        for octave in np.unique(octaves):
            members = np.flatnonzero(octaves == octave)
            self._groups.append((members, cKDTree(centres[members]), float(radii_m[members].max())))

    def near(
        self, points: Float[np.ndarray, "n 3"], reach_m: float
    ) -> tuple[Int[np.ndarray, "k"], Int[np.ndarray, "k"]]:
        """Return all pairs (point, face) where the sphere of the face may be within reach of the point."""
        query = cKDTree(points)
        pairs = [
            (found["i"], members[found["j"]])
            for members, tree, radius_m in self._groups
            for found in [query.sparse_distance_matrix(tree, reach_m + radius_m, output_type="ndarray")]
        ]
        return np.concatenate([pair[0] for pair in pairs]), np.concatenate([pair[1] for pair in pairs])
