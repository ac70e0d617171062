"""Inpaint vertex colours that no frame shows: harmonic interpolation of the observed colours over the surface."""

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import diags_array

from pipeline.geometry.atlas import Texels
from pipeline.geometry.linear_systems import factorise_positive_definite
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import laplacian

OBSERVED = 0.5
"""Weight from which a vertex is observed: others may take its colour."""

SMOOTHNESS_WEIGHT = 0.02
REGULARISATION_WEIGHT = 1e-6


def average_texels_per_vertex(
    texels: Texels,
    faces: Int[np.ndarray, "f 3"],
    vertex_count: int,
    colour: Float[np.ndarray, "t c"],
    weight: Float[np.ndarray, "t"],
) -> tuple[Float[np.ndarray, "v c"], Float[np.ndarray, "v"]]:
    """Return the weighted mean colour of the texels around each vertex, and the mean weight of these texels.

    A texel contributes to the three vertices of its face, in proportion to its barycentric coordinates.

    weight: one per texel, >= 0. Both results are 0 for a vertex without texels.
    """
    total, every, summed = np.zeros(vertex_count), np.zeros(vertex_count), np.zeros((vertex_count, colour.shape[1]))
    for corner, share in enumerate(texels.barycentric.T):
        vertex, weighted = faces[texels.face, corner], share * weight
        every += np.bincount(vertex, share, vertex_count)
        total += np.bincount(vertex, weighted, vertex_count)
        for channel, column in enumerate(colour.T):
            summed[:, channel] += np.bincount(vertex, weighted * column, vertex_count)
    mean = summed / np.maximum(total, 1e-12)[:, None]
    mean_weight = total / np.maximum(every, 1e-12)
    return mean.astype(np.float32), mean_weight.astype(np.float32)


def inpaint_vertex_colours(
    mesh: Mesh, colour: Float[np.ndarray, "v c"], weight: Float[np.ndarray, "v"]
) -> Float[np.ndarray, "v c"]:
    """Return the smoothest colours x that keep to `colour` c where `weight` w (in [0, 1]) is near 1.

    Minimises sum_i w_i |x_i - c_i|^2 + SMOOTHNESS_WEIGHT * sum over edges |x_i - x_j|^2, so x is harmonic where w = 0.
    Connected components with w = 0 everywhere get the weighted mean colour.
    """
    data_weight = weight.astype(np.float64)
    mean = (data_weight @ colour) / max(data_weight.sum(), 1e-12)
    degree = np.bincount(mesh.edges().ravel(), minlength=len(colour)).astype(np.float64)
    operator = diags_array(degree) @ laplacian(mesh)
    factor = factorise_positive_definite(
        diags_array(data_weight + REGULARISATION_WEIGHT) + SMOOTHNESS_WEIGHT * operator
    )
    return factor.solve(data_weight[:, None] * colour + REGULARISATION_WEIGHT * mean).astype(np.float32)
