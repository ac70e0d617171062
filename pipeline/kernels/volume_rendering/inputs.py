"""Inputs and output of the fused renderer.

Notation: n rays, k frames of a batch, s samples, p points, w features of a point, h hidden units, j joints.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.kernels.hashgrid import GridLayout
from pipeline.kernels.inverse_skinning import SkinGrid
from pipeline.kernels.volume_rendering.cpu import FieldArrays, NetworkArrays, SkinningArrays

MIN_TRANSMITTANCE = 1e-3
"""A ray ends below this transmittance; what is behind changes the pixel by at most a quarter of an 8-bit level."""
GRADIENT_SUBSAMPLING_THRESHOLD = 0.3
"""Samples with a gradient below this fraction of the mean gradient are subsampled, which leaves about a quarter of the
samples. The added variance of the gradient of a step is 1e-4 of its square (docs/decisions/field.md).
"""


class BatchSkinning(NamedTuple):
    """Skinning of the k frames of a batch, for the Newton step.

    batch_index: frame of the batch that each ray belongs to, in non-decreasing order.
    """

    skin: SkinGrid
    canonical_to_posed: Float[Tensor, "k j 4 4"]
    batch_index: Int[Tensor, "n"]

    @staticmethod
    def empty(rays: int) -> "BatchSkinning":
        """Return a skinning without frames: samples stay where the warp grids put them."""
        empty = torch.zeros(0, 3)
        empty_grid = SkinGrid(torch.zeros(3), 1.0, torch.zeros(0, 0, 0, dtype=torch.int32), empty, empty[:, 0], empty)
        return BatchSkinning(empty_grid, torch.zeros(0, 1, 4, 4), torch.zeros(rays, dtype=torch.int64))

    def arrays(self) -> SkinningArrays:
        """Return the skinning for the compiled loops."""
        matrices = self.canonical_to_posed.detach().contiguous().flatten(2).numpy()
        return SkinningArrays(self.batch_index.contiguous().numpy(), self.skin.cell_weights, matrices)


@dataclass(frozen=True)
class RadianceNetwork:
    """Hash grid and network: raw = relu(features hidden) output + bias.

    The colour is sigmoid(raw[:3]). The density (1/m) is initial_density_per_m * exp(raw[3]), with raw[3] clamped to
    [-exponent_limit, exponent_limit]; the gradient is not clamped. The hash grid fills the box `bounds_m`. `gate`, if
    there is one, fills it too: each of its voxels multiplies the density at the points in it.
    """

    bounds_m: Float[Tensor, "2 3"]
    table: Float[Tensor, "rows f"]
    layout: GridLayout
    hidden: Float[Tensor, "w h"]
    output: Float[Tensor, "h 4"]
    bias: Float[Tensor, "4"]
    initial_density_per_m: float
    exponent_limit: float
    gate: Float[Tensor, "gx gy gz"] | None = None

    @cached_property
    def arrays(self) -> FieldArrays:
        """The field for the compiled loops; it is on the CPU."""
        network = NetworkArrays(
            self.hidden.detach().numpy(),
            self.output.detach().numpy(),
            self.bias.detach().numpy(),
            np.float32(self.initial_density_per_m),
            np.float32(self.exponent_limit),
        )
        gate = np.empty((0, 0, 0), np.float32) if self.gate is None else self.gate.detach().contiguous().numpy()
        return FieldArrays(self.bounds_m.numpy(), self.layout.arrays(self.table), self.layout.lanes, network, gate)


@dataclass(frozen=True)
class RenderSettings:
    """Sampling of rays, and the approximations of the fused renderer (0 and 0: exact).

    step_m: distance between samples. max_samples: of one ray; samples farther away are dropped.
    """

    step_m: float
    max_samples: int
    min_transmittance: float = MIN_TRANSMITTANCE
    gradient_subsampling_threshold: float = GRADIENT_SUBSAMPLING_THRESHOLD


class RenderOutput(NamedTuple):
    """Premultiplied colour and alpha of the rays, density (1/m) of the points, and the samples in arbitrary order.

    Samples: canonical position before the Newton step, transmittance in front of the sample, weight in its pixel.
    """

    image: Float[Tensor, "n 3"]
    alpha: Float[Tensor, "n"]
    density_per_m: Float[Tensor, "p"]
    canonical_m: Float[Tensor, "s 3"]
    transmittance: Float[Tensor, "s"]
    weight: Float[Tensor, "s"]


class OutputGradients(NamedTuple):
    """Gradients of image and alpha of the rays, and of the density of the points."""

    image: Float[Tensor, "n 3"]
    alpha: Float[Tensor, "n"]
    density: Float[Tensor, "p"]


class RenderGradients(NamedTuple):
    """Gradients of the parameters; None for a gate or a skinning that there is not."""

    hidden: Float[Tensor, "w h"]
    output: Float[Tensor, "h 4"]
    bias: Float[Tensor, "4"]
    gate: Float[Tensor, "gx gy gz"] | None
    canonical_to_posed: Float[Tensor, "k j 4 4"] | None
