"""Small closed meshes with known geometry."""

import numpy as np

from data_tools.surface import split_at_midpoints, with_midpoints

TETRAHEDRON = (
    np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=np.float32),
    np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]], dtype=np.int32),
)


def octahedron() -> tuple[np.ndarray, np.ndarray]:
    """Corners on the axes at distance 1, faces counter-clockwise from outside."""
    vertices = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=np.float32)
    faces = [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]]
    return vertices, np.array(faces, dtype=np.int32)


def sphere(radius_m: float, centre_m: tuple[float, float, float], rounds: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """A finely split octahedron blown up to a sphere."""
    vertices, faces = octahedron()
    for _ in range(rounds):
        pairs, faces = split_at_midpoints(faces, len(vertices))
        vertices = with_midpoints(vertices, pairs)
        vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    return (vertices * radius_m + np.array(centre_m)).astype(np.float32), faces
