"""Canonical radiance field: multiresolution hash grid (Mueller et al. 2022), one hidden layer, colour and density.

Colour does not depend on the viewing direction, because the texture of the avatar must not either.

Letters: n points, w features per point.
"""

import math
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.field.baselines.positional_mlp import PositionalMlp
from pipeline.kernels.common.voxels import voxel_values
from pipeline.kernels.hashgrid import FeatureGradients, GridLayout, encode

EMPTY_GRID_LAYOUT = GridLayout((), 1, 0)

INITIAL_DENSITY_PER_M = 10.0
"""Density before training. A torso of 0.2 m then has an opacity of 0.86, so that all samples inside have a gradient."""

MAX_ABS_LOG_DENSITY = 7.0
"""density = INITIAL_DENSITY_PER_M * exp(raw), where raw is clamped to plus and minus this value."""

CPU_CHUNK_POINTS = 8192
"""Points per chunk of the network on the CPU: the activations fit into the cache."""

QUERY_CHUNK_POINTS = 1 << 18
"""Points per chunk of a query without gradient."""

MIN_RELATIVE_GRADIENT = 1e-3
"""Points whose gradient is below this fraction of the mean are skipped in the backward pass. They are half of the
points, most of them behind a surface, and contribute less than a thousandth of the gradient.
"""


class _RadianceMlp(torch.autograd.Function):
    """relu(features W1) W2 + b, then a sigmoid for three colours and an exponential for the density.

    The backward pass computes the hidden layer again, which is faster than to store it. The exponent is clamped, but
    its gradient is not (truncated exponential of Instant-NGP), so that a density at the limit can return.
    """

    @staticmethod
    def forward(ctx: Any, features: Tensor, hidden: Tensor, output: Tensor, bias: Tensor) -> tuple[Tensor, Tensor]:
        raw, chunk_size = features.new_empty(4, len(features)), _chunk_size(features)
        for chunk, raw_chunk in zip(features.split(chunk_size), raw.split(chunk_size, dim=1), strict=True):
            torch.mm(output.T, (chunk @ hidden).clamp_(min=0).T, out=raw_chunk)
        raw = raw.T + bias
        colour = torch.sigmoid(raw[:, :3])
        density = INITIAL_DENSITY_PER_M * torch.exp(raw[:, 3].clamp(-MAX_ABS_LOG_DENSITY, MAX_ABS_LOG_DENSITY))
        ctx.save_for_backward(features, hidden, output, colour, density)
        return colour, density

    @staticmethod
    def backward(ctx: Any, grad_colour: Tensor, grad_density: Tensor) -> tuple[Tensor, ...]:
        features, hidden, output, colour, density = ctx.saved_tensors
        grad_raw = torch.empty(len(colour), 4).to(colour)
        torch.mul(grad_colour, colour * (1 - colour), out=grad_raw[:, :3])
        torch.mul(grad_density, density, out=grad_raw[:, 3])
        grad_features = torch.zeros_like(features)
        grad_hidden, grad_output = torch.zeros_like(hidden), torch.zeros_like(output)
        gradient_magnitude = grad_raw.abs().amax(1)
        for rows in torch.nonzero(gradient_magnitude > MIN_RELATIVE_GRADIENT * gradient_magnitude.mean())[:, 0].split(
            _chunk_size(features)
        ):
            chunk, grad_raw_chunk = features.index_select(0, rows), grad_raw.index_select(0, rows)
            activation = (chunk @ hidden).clamp_(min=0)
            grad_output.T.addmm_(grad_raw_chunk.T, activation)
            grad_preactivation = (grad_raw_chunk @ output.T).mul_(activation.sign_())
            grad_hidden.addmm_(chunk.T, grad_preactivation)
            grad_features.index_copy_(0, rows, grad_preactivation @ hidden.T)
        return grad_features, grad_hidden, grad_output, grad_raw.sum(0)


def _chunk_size(features: Tensor) -> int:
    return CPU_CHUNK_POINTS if features.device.type == "cpu" else max(len(features), 1)


class RadianceField(torch.nn.Module):
    """Colour and density of canonical points.

    bounds_m: low and high corner of the box outside which the density is 0, m. layout: levels of the hash grid over
    that box. trunk: network that replaces the hash grid; the layout is then `EMPTY_GRID_LAYOUT`. inverse_skinning:
    method for renders (`pipeline.field.inverse_skinning`), which finds the same points as the one of the training.
    """

    bounds_m: Tensor
    table: Tensor
    gate: Tensor | None
    """Factors (gx, gy, gz) of the density, one for each voxel of the box; None: no factors. Voxel attention sets it."""

    def __init__(
        self,
        bounds_m: Float[np.ndarray, "2 3"],
        layout: GridLayout,
        hidden_width: int = 64,
        seed: int = 0,
        trunk: PositionalMlp | None = None,
        inverse_skinning: str = "baked",
    ) -> None:
        super().__init__()
        self.layout, self.trunk, self.inverse_skinning = layout, trunk, inverse_skinning
        width = trunk.width if trunk else layout.width
        self.register_buffer("bounds_m", torch.tensor(bounds_m, dtype=torch.float32))
        self.register_buffer("gate", None)
        rng = torch.Generator().manual_seed(seed)
        table = _uniform((layout.rows, layout.features), 1e-4, rng)
        if trunk:
            # A table without rows is no parameter of the optimiser.
            self.register_buffer("table", table.detach())
        else:
            self.table = table
        self.hidden = _uniform((width, hidden_width), math.sqrt(6 / width), rng)
        self.output = _uniform((hidden_width, 4), math.sqrt(1 / hidden_width), rng)
        self.bias = torch.nn.Parameter(torch.zeros(4))

    def radiance(
        self, x_canonical_m: Float[Tensor, "n 3"], feature_gradients: FeatureGradients | None = None
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n"]]:
        """Return colour and density without the test for the bounds, for training.

        feature_gradients: see `pipeline.kernels.hashgrid.encode`.
        """
        unit = (x_canonical_m - self.bounds_m[0]) / (self.bounds_m[1] - self.bounds_m[0])
        features = self.trunk(unit) if self.trunk else encode(unit, self.table, self.layout, feature_gradients)
        colour, density = _RadianceMlp.apply(features, self.hidden, self.output, self.bias)
        return colour, density if self.gate is None else density * voxel_values(unit, self.gate)

    def forward(self, x_canonical_m: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n"]]:
        """Return colour (n, 3) in [0, 1] and density (n) >= 0, 1/m, of canonical points (m).

        The density is 0 outside the bounds.
        """
        inside = ((x_canonical_m >= self.bounds_m[0]) & (x_canonical_m <= self.bounds_m[1])).all(-1)
        colour, density = self.radiance(x_canonical_m)
        return colour, density * inside

    def density(self, x_canonical_m: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Return the density (1/m) without gradient, chunk by chunk."""
        with torch.no_grad():
            return torch.cat([self(chunk)[1] for chunk in x_canonical_m.split(QUERY_CHUNK_POINTS)])

    def colour(self, x_canonical_m: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Return the colour without gradient, chunk by chunk."""
        with torch.no_grad():
            return torch.cat([self(chunk)[0] for chunk in x_canonical_m.split(QUERY_CHUNK_POINTS)])


class FieldColours(torch.nn.Module):
    """The colours of a field, to be optimised together with a surface."""

    def __init__(self, field: RadianceField) -> None:
        super().__init__()
        self.field = field

    def forward(
        self, points_m: Float[Tensor, "n 3"], feature_gradients: FeatureGradients | None = None
    ) -> Float[Tensor, "n 3"]:
        """Return colours in [0, 1] at canonical points; feature_gradients: see `pipeline.kernels.hashgrid.encode`."""
        return self.field.radiance(points_m, feature_gradients)[0]


def _uniform(shape: tuple[int, int], limit: float, rng: torch.Generator) -> torch.nn.Parameter:
    return torch.nn.Parameter((2 * torch.rand(shape, generator=rng) - 1) * limit)


def hash_grid_layout(
    bounds_m: Float[np.ndarray, "2 3"], finest_cell_m: float, levels: int, features: int, log2_hashmap_size: int
) -> GridLayout:
    """Return hash grid levels in equal ratios from 1/16 of the longest side of the box to the finest cell.

    finest_cell_m: edge of the finest cell, m. Cells finer than a pixel's footprint on the body cannot be observed
    (Nyquist), coarser ones blur. features: per level. log2_hashmap_size: log2 of the most rows of a level.
    """
    extent = np.asarray(bounds_m[1] - bounds_m[0], dtype=np.float64)
    coarsest = max(float(extent.max()) / 16, finest_cell_m)
    ratio = (finest_cell_m / coarsest) ** (1 / max(levels - 1, 1))
    cells = tuple(
        tuple(max(1, math.ceil(side / (coarsest * ratio**level))) for side in extent) for level in range(levels)
    )
    return GridLayout(cells, features, log2_hashmap_size)
