"""Transfer of skin weights from the body to the canonical mesh.

Reference: Abdrashitov et al., "Robust Skin Weights Transfer via Weight Inpainting", SIGGRAPH Asia 2023.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_array
from scipy.sparse.linalg import splu
from torch import Tensor

from pipeline.body.body import Body
from pipeline.geometry.differentiable_raster import face_adjacency
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.skinning import dense_weights, top_k_weights
from pipeline.geometry.surface import closest_points_on_mesh, laplacian
from pipeline.kernels.blend import SparseWeights

MIN_NORMAL_COSINE = 0.5
"""Smallest cosine between the normals of a vertex and of its closest point on the body: 60 degrees."""
WEIGHT_SMOOTHING_STEP = 0.5
"""Fraction by which a smoothing step moves the weights of a vertex towards the mean of its neighbours."""


@dataclass(frozen=True)
class SkinnedTopology:
    """Faces, face adjacency and skin weights of a mesh, which stay fixed while its vertices are optimised.

    faces, adjacency: int32, as the kernels read them.
    """

    faces: Int[Tensor, "f 3"]
    adjacency: Int[Tensor, "f 3"]
    weights: Float[Tensor, "v j"]

    @cached_property
    def sparse_weights(self) -> SparseWeights:
        """The weights without their zeros."""
        return SparseWeights.from_dense(self.weights)


def transfer_skin(mesh: Mesh, body: Body) -> SkinnedTopology:
    """Transfer the skin weights of the body to a mesh and keep four influences per vertex, as in the export."""
    return skin_as_exported(mesh, transfer_skin_weights(mesh, body))


def skin_as_exported(mesh: Mesh, weights: Float[np.ndarray, "v j"]) -> SkinnedTopology:
    """Return the topology of a mesh with four influences per vertex of its skin weights, as in the export."""
    indices, kept = top_k_weights(weights)
    return build_skinned_topology(
        mesh, dense_weights(torch.from_numpy(indices), torch.from_numpy(kept), weights.shape[1])
    )


def build_skinned_topology(mesh: Mesh, weights: Float[Tensor, "v j"]) -> SkinnedTopology:
    """Build the topology of a mesh with known skin weights."""
    faces = torch.from_numpy(mesh.faces.astype(np.int32))
    return SkinnedTopology(faces, face_adjacency(faces), weights)


def transfer_skin_weights(
    mesh: Mesh, body: Body, max_body_distance_m: float = 0.25, smoothing_steps: int = 4
) -> Float[np.ndarray, "v j"]:
    """Return skin weights (rows sum to 1) of a mesh that surrounds the body in the canonical pose.

    A vertex is matched with its closest point on the body if that is within reach and the normals differ by at most 60
    degrees; it takes the weights of that point. The weights of all other vertices (the inner side of an arm that is
    closer to the trunk, loose clothing) are the harmonic interpolation of the matched ones over the mesh. Smoothing
    steps follow.

    Args:
        mesh: the mesh in the canonical pose, m.
        body: the fitted body.
        max_body_distance_m: largest distance of a match, m.
        smoothing_steps: number of smoothing steps.
    """
    body_mesh = body.mesh()
    distance_m, face, barycentric = closest_points_on_mesh(mesh.vertices, body_mesh)
    weights = np.einsum("nk,nkj->nj", barycentric, body.skin_weights[body.faces[face]])
    normals = np.einsum("nk,nkj->nj", barycentric, body_mesh.vertex_normals()[body.faces[face]])
    cosine = np.sum(normals * mesh.vertex_normals(), axis=1)
    matched = (distance_m <= max_body_distance_m) & (cosine >= MIN_NORMAL_COSINE)
    operator = laplacian(mesh)
    if matched.any() and not matched.all():
        weights[~matched] = _interpolate_harmonically(operator, weights, matched)
    for _ in range(smoothing_steps):
        weights = weights - WEIGHT_SMOOTHING_STEP * (operator @ weights)
    weights = np.clip(weights, 0.0, None)
    return (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)


def _interpolate_harmonically(
    operator: csr_array, values: Float[np.ndarray, "v c"], known: Bool[np.ndarray, "v"]
) -> Float[np.ndarray, "u c"]:
    """Return values at the unknown vertices that equal the mean of their neighbours.

    `igl.harmonic` is not used: it has the cotangent Laplacian, and its system is singular for a connected component
    without a known vertex. Here a weight of 1e-6 of the initial values keeps such a system regular.
    """
    rows = operator[~known]
    inner = rows[:, ~known].tocsc()
    inner.setdiag(inner.diagonal() + 1e-6)
    return splu(inner).solve(1e-6 * values[~known] - rows[:, known] @ values[known])
