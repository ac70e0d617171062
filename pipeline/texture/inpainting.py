"""Colours for the parts of a surface that no frame shows: what is seen around them, spread over the surface."""

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csc_array, diags_array
from scipy.sparse.linalg import splu

from pipeline.geometry.atlas import Texels
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import laplacian

SMOOTHNESS_WEIGHT = 0.02
REGULARISATION_WEIGHT = 1e-6


def average_texels_per_vertex(
    texels: Texels,
    faces: Int[np.ndarray, "f 3"],
    count: int,
    colour: Float[np.ndarray, "t c"],
    weight: Float[np.ndarray, "t"],
) -> tuple[Float[np.ndarray, "v c"], Float[np.ndarray, "v"]]:
    """Weighted mean colour of the texels around each vertex, and their mean weight; 0 where no texel is."""
    corner_weight = texels.barycentric.ravel()
    vertex = faces[texels.face].ravel()
    weighted = corner_weight * np.repeat(weight, 3)
    total = np.bincount(vertex, weighted, count)
    summed = [np.bincount(vertex, weighted * np.repeat(column, 3), count) for column in colour.T]
    mean = np.stack(summed, axis=1) / np.maximum(total, 1e-12)[:, None]
    return mean.astype(np.float32), (total / np.maximum(np.bincount(vertex, corner_weight, count), 1e-12)).astype(
        np.float32
    )


def spread(mesh: Mesh, colour: Float[np.ndarray, "v c"], weight: Float[np.ndarray, "v"]) -> Float[np.ndarray, "v c"]:
    """The smoothest colours that keep to `colour` where `weight` (in [0, 1]) is near 1.

    Minimises sum w |x - c|^2 + STIFFNESS * sum over edges |x_i - x_j|^2: harmonic where nothing is seen. Pieces of the
    mesh that nobody sees at all get the mean colour.
    """
    data_weight = weight.astype(np.float64)
    mean = (data_weight @ colour) / max(data_weight.sum(), 1e-12)
    degree = np.bincount(mesh.edges().ravel(), minlength=len(colour)).astype(np.float64)
    operator = diags_array(degree) @ laplacian(mesh)
    matrix = csc_array(diags_array(data_weight + REGULARISATION_WEIGHT) + SMOOTHNESS_WEIGHT * operator)
    return splu(matrix).solve(data_weight[:, None] * colour + REGULARISATION_WEIGHT * mean).astype(np.float32)
