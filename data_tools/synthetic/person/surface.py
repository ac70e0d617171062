"""Mesh operations of the clothing model: midpoint subdivision, smoothing, connected components, convex hulls."""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Float, Int

_PARALLEL_EPS = 1e-9
"""Rays with a smaller cosine to the plane normal are treated as parallel to the plane."""


@dataclass(frozen=True)
class WornSurface:
    """A closed surface with UV that is worn over the body; rows of `faces_uv` correspond to rows of `faces`."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    uv: Float[np.ndarray, "t 2"]
    faces_uv: Int[np.ndarray, "f 3"]
    skin_weights: Float[np.ndarray, "v j"]


def subdivide_at_midpoints(
    faces: Int[np.ndarray, "f 3"], vertex_count: int
) -> tuple[Int[np.ndarray, "m 2"], Int[np.ndarray, "g 3"]]:
    """Split each triangle into four.

    Returns:
        Vertex pairs whose midpoints become vertices `vertex_count`, `vertex_count + 1`, ..., and the new faces. The
        children of face i are rows 4 i to 4 i + 3, so faces over positions and faces over UV stay aligned.
    """
    half_edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    pairs, edge_of = np.unique(half_edges, axis=0, return_inverse=True)
    middle = (edge_of.reshape(-1, 3) + vertex_count).astype(faces.dtype)
    a, b, c = faces.T
    ab, bc, ca = middle.T
    children = np.stack([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]])
    return pairs, children.transpose(2, 0, 1).reshape(-1, 3)


def append_midpoint_values(values: Float[np.ndarray, "v c"], pairs: Int[np.ndarray, "m 2"]) -> Float[np.ndarray, "w c"]:
    """Append the values of the midpoints to per-vertex values."""
    return np.concatenate([values, values[pairs].mean(axis=1, dtype=values.dtype)])


def neighbour_averaging_matrix(faces: Int[np.ndarray, "f 3"], vertex_count: int) -> sparse.csr_matrix:
    """Return the row-stochastic matrix of uniform neighbour averages; isolated vertices map to themselves."""
    pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    pairs = np.concatenate([pairs, pairs[:, ::-1]])
    adjacency = sparse.coo_matrix((np.ones(len(pairs)), pairs.T), shape=(vertex_count, vertex_count)).tocsr()
    adjacency.data[:] = 1.0
    is_isolated = np.asarray(adjacency.sum(axis=1)).ravel() == 0
    adjacency = adjacency + sparse.diags(is_isolated.astype(float))
    return sparse.diags(1.0 / np.asarray(adjacency.sum(axis=1)).ravel()) @ adjacency


def smooth_laplacian(
    vertices: Float[np.ndarray, "v 3"], mean: sparse.csr_matrix, iterations: int
) -> Float[np.ndarray, "v 3"]:
    """Apply uniform Laplacian smoothing with step size 0.5."""
    result = vertices.astype(np.float64)
    for _ in range(iterations):
        result = 0.5 * (result + mean @ result)
    return result.astype(vertices.dtype)


def face_components(faces: Int[np.ndarray, "f 3"], vertex_count: int) -> Int[np.ndarray, "f"]:
    """Return the connected component of each face, numbered by descending face count."""
    pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    graph = sparse.coo_matrix((np.ones(len(pairs)), pairs.T), shape=(vertex_count, vertex_count))
    component = sparse.csgraph.connected_components(graph, directed=False)[1][faces[:, 0]]
    by_size = np.argsort(-np.bincount(component), kind="stable")
    rank = np.empty_like(by_size)
    rank[by_size] = np.arange(len(by_size))
    return rank[component].astype(np.int32)


def hull_exit_distance_m(
    starts_m: Float[np.ndarray, "#n d"],
    directions: Float[np.ndarray, "n d"],
    half_spaces: Float[np.ndarray, "h e"],
    margin_m: float = 0.0,
) -> Float[np.ndarray, "n"]:
    """Return the distance along rays from inside a convex hull to its surface, offset by a margin.

    A half-space n·x + d <= 0 (a row of `ConvexHull.equations`: unit normal n, offset d) bounds the ray a + t u at
    t = (margin - n·a - d) / (n·u); the smallest positive t is the exit.
    """
    normals, offsets_m = half_spaces[:, :-1].T, half_spaces[:, -1]
    slope = directions @ normals
    plane_distance_m = margin_m - (starts_m @ normals + offsets_m)
    return np.where(slope > _PARALLEL_EPS, plane_distance_m / np.maximum(slope, _PARALLEL_EPS), np.inf).min(axis=1)
