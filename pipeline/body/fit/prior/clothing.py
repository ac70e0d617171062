"""Clothes in the fit: smooth offsets of the body's surface along its normals, fitted as shape parameters.

Masks show clothes, the parametric body is bare. What its shape cannot explain, the poses do: under a coat the hips
turned by 4 degrees to where the body is as wide as the mask. The offset is a sum of manifold harmonics (Vallet and
Levy, "Spectral geometry processing with manifold harmonics", 2008) of trunk and limbs with a Gaussian prior, small for
short wavelengths. Heads, hands and feet have none. The body that results is the bare one that fills these clothes: the
offset itself is not told where nothing is seen, between the legs.

Dimensions: v vertices, s parameters of the bare shape, c harmonics.
"""

from collections.abc import Callable
from dataclasses import replace

import igl
import numpy as np
import torch
from jaxtyping import Float
from scipy.sparse import csc_matrix
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import eigsh
from torch import Tensor

from pipeline.body.fit.linear_body import LinearBody
from pipeline.body.fit.prior.priors import ShapePrior
from pipeline.body.fit.silhouette_icp import HEAD_AND_FOOT_JOINTS

HARMONICS = 60

OFFSET_STD_M = 0.03
"""Prior standard deviation of the offset, as the root mean square over the surface."""

SMOOTH_LENGTH_M = 0.12
"""A harmonic of wavelength 2 pi times this has half the standard deviation of a constant offset."""

LARGEST_OFFSET = 5.0
"""Bound of each parameter, in standard deviations."""

FILL_STD_M, FILL_JOINT_STD_M = 0.01, 0.001
"""Standard deviations of the surface and of the joints of the body that fills the clothes."""

FILL_POINTS = 1000
"""Independent points as which the surface counts, about as many as the silhouettes of a fit."""

FILL_STEPS = 3
"""Gauss-Newton steps; the shape is nearly linear in its parameters."""

BARE_JOINTS = (*HEAD_AND_FOOT_JOINTS, "LeftHand", "RightHand")


def clothing_offsets(model: LinearBody) -> Float[Tensor, "v 3 c"]:
    """Return the offset of each vertex of a bare body (m) by one standard deviation of each harmonic."""
    vertices_m, faces = model.vertices_m.numpy(), model.faces.numpy().astype(np.int64)
    stiffness = -igl.cotmatrix(vertices_m, faces)
    mass = igl.massmatrix(vertices_m, faces, igl.MASSMATRIX_TYPE_VORONOI)
    _, part = connected_components(stiffness)  # eyeballs and teeth are parts of their own
    is_bare = model.skin_weight_of(BARE_JOINTS).numpy() > 0.5
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


def fill_clothes(
    clothed: LinearBody,
    shape: Float[Tensor, "s"],
    prior: ShapePrior,
    linearise: Callable[[Float[Tensor, "s"]], LinearBody],
) -> Float[Tensor, "s"]:
    """Return the parameters of the bare body whose surface is nearest to a clothed one and whose joints are the same.

    shape: of the body below the clothes. prior: of these parameters. linearise: the bare body around a shape.
    """
    for _ in range(FILL_STEPS):
        bare = linearise(shape)
        surface_scale = (FILL_POINTS / len(bare.vertices_m)) ** 0.5 / FILL_STD_M
        jacobian = torch.cat(
            [
                bare.vertices_shape_jacobian.flatten(0, 1) * surface_scale,
                bare.joints_shape_jacobian.flatten(0, 1) / FILL_JOINT_STD_M,
                torch.diag(1.0 / prior.std),
            ]
        )
        residual = torch.cat(
            [
                (clothed.vertices_m - bare.vertices_m).flatten() * surface_scale,
                (clothed.joints_m - bare.joints_m).flatten() / FILL_JOINT_STD_M,
                (prior.mean - shape) / prior.std,
            ]
        )
        step = torch.linalg.solve(jacobian.T @ jacobian, jacobian.T @ residual)
        shape = (shape + step).clamp(prior.lower_bound, prior.upper_bound)
    return shape


def _lowest_eigenvectors(
    stiffness: csc_matrix, mass: csc_matrix
) -> tuple[Float[np.ndarray, "c"], Float[np.ndarray, "d c"]]:
    """Return eigenvalues (1/m^2) and eigenvectors of the Laplacian, orthonormal with respect to the mass."""
    start = np.linspace(1.0, 2.0, stiffness.shape[0])  # random by default: results would differ from run to run
    eigenvalues, eigenvectors = eigsh(stiffness, HARMONICS, mass, sigma=-0.01, v0=start)
    return eigenvalues, eigenvectors
