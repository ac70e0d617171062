"""Clothes in the fit: smooth offsets of the body's surface along its normals, fitted as shape parameters.

Masks show clothes, the parametric body is bare. What its shape cannot explain, the poses do: under a coat the hips
turned by 4 degrees to where the body is as wide as the mask. The offset is a sum of manifold harmonics (Vallet and
Levy, "Spectral geometry processing with manifold harmonics", 2008) of trunk and limbs with a Gaussian prior, small for
short wavelengths. Heads, hands and feet have none. Only the fit uses it: the body that it returns is bare.

Dimensions: v vertices, s parameters of the bare shape, c harmonics.
"""

from dataclasses import replace

import igl
import numpy as np
import torch
from jaxtyping import Float
from scipy.sparse import csc_matrix
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import eigsh
from torch import Tensor

from pipeline.body.fit.linear_body import ACTIVE_JOINTS, LinearBody
from pipeline.body.fit.prior.priors import ShapePrior

HARMONICS = 60

OFFSET_STD_M = 0.03
"""Prior standard deviation of the offset, as the root mean square over the surface."""

SMOOTH_LENGTH_M = 0.12
"""A harmonic of wavelength 2 pi times this has half the standard deviation of a constant offset."""

LARGEST_OFFSET = 5.0
"""Bound of each parameter, in standard deviations."""

BARE_JOINTS = ("Head", "LeftHand", "RightHand", "LeftFoot", "LeftToeBase", "RightFoot", "RightToeBase")


def clothing_offsets(model: LinearBody) -> Float[Tensor, "v 3 c"]:
    """Return the offset of each vertex of a bare body (m) by one standard deviation of each harmonic."""
    vertices_m, faces = model.vertices_m.numpy(), model.faces.numpy().astype(np.int64)
    stiffness = -igl.cotmatrix(vertices_m, faces)
    mass = igl.massmatrix(vertices_m, faces, igl.MASSMATRIX_TYPE_VORONOI)
    _, part = connected_components(stiffness)  # eyeballs and teeth are parts of their own
    is_bare = model.skin_weights[:, [ACTIVE_JOINTS.index(name) for name in BARE_JOINTS]].sum(1).numpy() > 0.5
    dressed = np.flatnonzero((part == np.bincount(part).argmax()) & ~is_bare)
    eigenvalues, harmonics = _lowest_eigenvectors(
        csc_matrix(stiffness[dressed][:, dressed]), csc_matrix(mass[dressed][:, dressed])
    )
    std = 1.0 / (1.0 + eigenvalues * SMOOTH_LENGTH_M**2)
    std *= OFFSET_STD_M * np.sqrt(mass.diagonal()[dressed].sum() / np.square(std).sum())
    offsets_m = np.zeros((*vertices_m.shape, HARMONICS))
    normals = igl.per_vertex_normals(vertices_m, faces)[dressed]
    offsets_m[dressed] = normals[:, :, None] * (harmonics * std)[:, None]
    return torch.from_numpy(offsets_m)


def dress(model: LinearBody, offsets_m: Float[Tensor, "v 3 c"], clothing: Float[Tensor, "c"]) -> LinearBody:
    """Return a linear body whose shape parameters are followed by those of the clothing, in standard deviations.

    The joints do not depend on the clothing.
    """
    count = len(clothing)
    return replace(
        model,
        shape=torch.cat([model.shape, clothing]),
        vertices_m=model.vertices_m + offsets_m @ clothing,
        vertices_shape_jacobian=torch.cat([model.vertices_shape_jacobian, offsets_m], dim=2),
        joints_shape_jacobian=torch.nn.functional.pad(model.joints_shape_jacobian, (0, count)),
        full_joints_shape_jacobian=torch.nn.functional.pad(model.full_joints_shape_jacobian, (0, count)),
    )


def with_clothing(prior: ShapePrior, count: int) -> ShapePrior:
    """Return the prior of the shape parameters followed by those of the clothing."""
    return ShapePrior(
        mean=torch.nn.functional.pad(prior.mean, (0, count)),
        std=torch.nn.functional.pad(prior.std, (0, count), value=1.0),
        lower_bound=torch.nn.functional.pad(prior.lower_bound, (0, count), value=-LARGEST_OFFSET),
        upper_bound=torch.nn.functional.pad(prior.upper_bound, (0, count), value=LARGEST_OFFSET),
    )


def _lowest_eigenvectors(
    stiffness: csc_matrix, mass: csc_matrix
) -> tuple[Float[np.ndarray, "c"], Float[np.ndarray, "d c"]]:
    """Return eigenvalues (1/m^2) and eigenvectors of the Laplacian, orthonormal with respect to the mass."""
    start = np.linspace(1.0, 2.0, stiffness.shape[0])  # random by default: results would differ from run to run
    eigenvalues, eigenvectors = eigsh(stiffness, HARMONICS, mass, sigma=-0.01, v0=start)
    return eigenvalues, eigenvectors
