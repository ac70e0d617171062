"""Depth-tested projective texturing: the colour and the confidence of every texel in one image."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.kernels.common.dispatch import runs_on_numba
from pipeline.kernels.texel_projection import cpu, reference
from pipeline.kernels.texel_projection.inputs import (
    ImageView,
    ProjectedMesh,
    ProjectionWeights,
    TexelPoints,
    TexelSums,
)

__all__ = [
    "ImageView",
    "ProjectedMesh",
    "ProjectionWeights",
    "TexelPoints",
    "TexelSums",
    "add_projections_",
    "project_texels",
]


def project_texels(
    mesh: ProjectedMesh, texels: TexelPoints, view: ImageView, tolerance_m: float = 0.01, min_cosine: float = 0.1
) -> tuple[Float[Tensor, "t c"], Float[Tensor, "t 2"]]:
    """Look up an image bilinearly at the projections of the texels' surface points. Not differentiable.

    A texel is visible if no surface in the 2 x 2 pixels of the lookup is in front of it by more than the tolerance
    (Shetty et al., "Holoported Characters", 2024, supplement B, equation 4; here one-sided, and over all four pixels,
    so that the colour of an occluder never enters).

    Args:
        tolerance_m: for surfaces that face the camera; it grows with 1 / cosine, as the depth range of a pixel does.
        min_cosine: texels with a lower cosine are invisible.

    Returns the values, and for each texel (confidence, cosine); all 0 where the texel is invisible.
    """
    if not runs_on_numba(*mesh[:3], texels.barycentric, *view):
        return reference.project_texels(mesh, texels, view, tolerance_m, min_cosine)
    arrays = _arrays(mesh, texels, view)
    values, weights = cpu.project_texels(*arrays, tolerance_m, min_cosine)
    return torch.from_numpy(values), torch.from_numpy(weights)


def add_projections_(
    sums: TexelSums, mesh: ProjectedMesh, texels: TexelPoints, view: ImageView, weighting: ProjectionWeights
) -> None:
    """Add the values of `project_texels`, weighted, and their weights to the sums of the texels.

    What a view needs beside the sums does not grow with the number of texels.
    """
    if not runs_on_numba(*sums, *mesh[:3], texels.barycentric, *view):
        reference.add_projections_(sums, mesh, texels, view, weighting)
        return
    totals = sums.values.numpy(), sums.weight.numpy()
    cpu.add_projections(totals, *_arrays(mesh, texels, view), tuple(float(value) for value in weighting))


def _arrays(
    mesh: ProjectedMesh, texels: TexelPoints, view: ImageView
) -> tuple[cpu.MeshArrays, np.ndarray, np.ndarray, cpu.ViewArrays]:
    return (
        cpu.MeshArrays(*(tensor.detach().contiguous().numpy() for tensor in (*mesh[:3], mesh.faces.int()))),
        texels.face.int().contiguous().numpy(),
        texels.barycentric.detach().contiguous().numpy(),
        cpu.ViewArrays(*(tensor.detach().contiguous().numpy() for tensor in view)),
    )
