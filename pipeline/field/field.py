"""The canonical radiance field: hash grid, one hidden layer, colour and density.

Colour depends on the place alone: an avatar's texture must not hold the light of one view.
"""

import math
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.field.positional_mlp import PositionalMlp
from pipeline.kernels.hashgrid import FeatureGradients, GridLayout, encode

EMPTY_GRID_LAYOUT = GridLayout((), 1, 0)

INITIAL_DENSITY_PER_M = 10.0
"""Before training a torso of 0.2 m is seen as 86 % opaque: enough for a signal, not so much that the inside gets
none.
"""

MAX_ABS_LOG_DENSITY = 7.0
"""density = START · exp(raw), with raw cut at plus and minus the limit."""

CPU_CHUNK_POINTS = 8192
"""Points that go through the network at once on the CPU: what lies between its layers stays in the cache."""

QUERY_CHUNK_POINTS = 1 << 18

MIN_RELATIVE_GRADIENT = 1e-3
"""Points whose gradient is below this part of the mean one get none. That is half of them, most behind a surface, and
together they hold less than a thousandth of the whole.
"""


class _RadianceMlp(torch.autograd.Function):
    """relu(features W1) W2 + b, sigmoid for three colours, exp for the density.

    Backward computes the hidden layer again rather than store it: that is less than the memory traffic it saves.

    The exponent is clamped, but its gradient is not cut there (as the truncated exponential of Instant-NGP), so that
    a density that ran away comes back.
    """

    @staticmethod
    def forward(ctx: Any, features: Tensor, hidden: Tensor, output: Tensor, bias: Tensor) -> tuple[Tensor, Tensor]:
        raw, chunk_size = features.new_empty(4, len(features)), _chunk_size(features)
        for part, into in zip(features.split(chunk_size), raw.split(chunk_size, dim=1), strict=True):
            torch.mm(output.T, (part @ hidden).clamp_(min=0).T, out=into)
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
            part, towards = features.index_select(0, rows), grad_raw.index_select(0, rows)
            activation = (part @ hidden).clamp_(min=0)
            grad_output.T.addmm_(towards.T, activation)
            grad_preactivation = (towards @ output.T).mul_(activation.sign_())
            grad_hidden.addmm_(part.T, grad_preactivation)
            grad_features.index_copy_(0, rows, grad_preactivation @ hidden.T)
        return grad_features, grad_hidden, grad_output, grad_raw.sum(0)


def _chunk_size(features: Tensor) -> int:
    return CPU_CHUNK_POINTS if features.device.type == "cpu" else max(len(features), 1)


class RadianceField(torch.nn.Module):
    """Colour and density of canonical points.

    bounds_m: (2, 3) box outside which there is nothing. layout: the hash grid's levels, over that box. trunk: a network
    in the grid's place, whose layout then is NO_GRID. inverse_skinning: the way in which posed points come to the field
    when it is shown, as in `pipeline.field.inverse_skinning`; it finds the same points as the one of the training.
    """

    bounds_m: Tensor
    table: Tensor

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
        random = torch.Generator().manual_seed(seed)
        table = _uniform((layout.rows, layout.features), 1e-4, random)
        if trunk:
            # It has no rows then: nothing that an optimiser could move.
            self.register_buffer("table", table.detach())
        else:
            self.table = table
        self.hidden = _uniform((width, hidden_width), math.sqrt(6 / width), random)
        self.output = _uniform((hidden_width, 4), math.sqrt(1 / hidden_width), random)
        self.bias = torch.nn.Parameter(torch.zeros(4))

    def radiance(
        self, x_canonical_m: Float[Tensor, "n 3"], towards: FeatureGradients | None = None
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n"]]:
        """Colour and density without the cut at the bounds; for training. `towards`: see `encode`."""
        unit = (x_canonical_m - self.bounds_m[0]) / (self.bounds_m[1] - self.bounds_m[0])
        features = self.trunk(unit) if self.trunk else encode(unit, self.table, self.layout, towards)
        return _RadianceMlp.apply(features, self.hidden, self.output, self.bias)

    def forward(self, x_canonical_m: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n"]]:
        """Colour (n, 3) in [0, 1] and density (n) in 1/m >= 0 of canonical points (m); density is 0 outside the
        bounds.
        """
        inside = ((x_canonical_m >= self.bounds_m[0]) & (x_canonical_m <= self.bounds_m[1])).all(-1)
        colour, density = self.radiance(x_canonical_m)
        return colour, density * inside

    def density(self, x_canonical_m: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Density (1/m) alone, without gradient, in parts that fit into the cache."""
        with torch.no_grad():
            return torch.cat([self(part)[1] for part in x_canonical_m.split(QUERY_CHUNK_POINTS)])

    def colour(self, x_canonical_m: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Colour alone, without gradient, in parts that fit into the cache."""
        with torch.no_grad():
            return torch.cat([self(part)[0] for part in x_canonical_m.split(QUERY_CHUNK_POINTS)])


def _uniform(shape: tuple[int, int], limit: float, random: torch.Generator) -> torch.nn.Parameter:
    return torch.nn.Parameter((2 * torch.rand(shape, generator=random) - 1) * limit)


def hash_grid_layout(
    bounds_m: Float[np.ndarray, "2 3"], finest_cell_m: float, levels: int, features: int, log2_rows: int
) -> GridLayout:
    """Levels from an eighth of the box's longest side down to the finest cell, in equal ratios.

    finest_cell_m: what a pixel covers on the body: finer cells cannot be observed (Nyquist), coarser ones blur.
    """
    extent = np.asarray(bounds_m[1] - bounds_m[0], dtype=np.float64)
    coarsest = max(float(extent.max()) / 16, finest_cell_m)
    ratio = (finest_cell_m / coarsest) ** (1 / max(levels - 1, 1))
    cells = tuple(
        tuple(max(1, math.ceil(side / (coarsest * ratio**level))) for side in extent) for level in range(levels)
    )
    return GridLayout(cells, features, log2_rows)
