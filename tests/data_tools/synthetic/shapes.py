"""Small closed meshes with known geometry."""

import numpy as np

from data_tools.synthetic.person.surface import append_midpoint_values, subdivide_at_midpoints

TETRAHEDRON = (
    np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=np.float32),
    np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]], dtype=np.int32),
)


def octahedron() -> tuple[np.ndarray, np.ndarray]:
    """Return an octahedron with unit radius; faces are counter-clockwise seen from outside."""
    vertices = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=np.float32)
    faces = [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]]
    return vertices, np.array(faces, dtype=np.int32)


def sphere(
    radius_m: float, centre_m: tuple[float, float, float], subdivisions: int = 4
) -> tuple[np.ndarray, np.ndarray]:
    """Return a subdivided octahedron projected to a sphere."""
    vertices, faces = octahedron()
    for _ in range(subdivisions):
        pairs, faces = subdivide_at_midpoints(faces, len(vertices))
        vertices = append_midpoint_values(vertices, pairs)
        vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    return (vertices * radius_m + np.array(centre_m)).astype(np.float32), faces


def ray_triangle_distances(origin: np.ndarray, direction: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return the sorted distances at which a ray hits triangles (Möller and Trumbore 1997), by brute force."""
    edge_1, edge_2, to_origin = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], origin - corners[:, 0]
    p, q = np.cross(direction, edge_2), np.cross(to_origin, edge_1)
    determinant = (edge_1 * p).sum(axis=1)
    determinant[np.abs(determinant) < 1e-14] = np.nan
    u, v, t = (to_origin * p).sum(axis=1) / determinant, q @ direction / determinant, (edge_2 * q).sum(1) / determinant
    return np.sort(t[(u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)])
