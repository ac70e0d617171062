"""Multi-resolution hash grid: features of points by trilinear interpolation in several grids at once.

Müller et al. 2022, "Instant Neural Graphics Primitives", section 3. Letters: n points, l levels, f features a level.

Two things differ from the paper, both measured (docs/decisions.md):
a level's cells are cubes in metres, so the number of cells is given per axis and a standing body wastes no table
rows on the empty half of a cube; levels whose nodes fit in the table are dense and have no collisions.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.kernels.common.dispatch import runs_on_numba
from pipeline.kernels.hashgrid import cpu as hashgrid_cpu
from pipeline.kernels.hashgrid import reference

SUPPORTED_FEATURE_COUNTS = (1, 2, 4, 8)


@dataclass(frozen=True)
class GridLayout:
    """Where each level's rows lie in the one table.

    `cells_per_axis` has a triple (x, y, z) of cell counts a level, coarse to fine; a level has at most
    2**`log2_rows` rows of `features` floats each.
    """

    cells_per_axis: tuple[tuple[int, int, int], ...]
    features: int
    log2_rows: int

    def __post_init__(self) -> None:
        if self.features not in SUPPORTED_FEATURE_COUNTS:
            raise ValueError(f"features per level must be one of {SUPPORTED_FEATURE_COUNTS}, not {self.features}")

    @property
    def levels(self) -> int:
        """Number of levels."""
        return len(self.cells_per_axis)

    @property
    def width(self) -> int:
        """Length of an encoded point."""
        return self.levels * self.features

    @cached_property
    def rows_per_level(self) -> tuple[int, ...]:
        """Table rows of each level: all its nodes, or 2**`log2_rows` that they share."""
        limit = 1 << self.log2_rows
        return tuple(min(limit, (x + 1) * (y + 1) * (z + 1)) for x, y, z in self.cells_per_axis)

    @cached_property
    def rows(self) -> int:
        """Rows of the whole table."""
        return sum(self.rows_per_level)

    @property
    def lanes(self) -> tuple[int, ...]:
        """As long as a level has features: tells the kernels that number by its type."""
        return (0,) * self.features

    @cached_property
    def level_params(self) -> np.ndarray:
        """(l, 6) int64 for the kernels: cells x, y, z; first row; rows; 1 if the level is dense."""
        level_params, first = [], 0
        for (x, y, z), rows in zip(self.cells_per_axis, self.rows_per_level, strict=True):
            level_params.append((x, y, z, first, rows, int((x + 1) * (y + 1) * (z + 1) <= rows)))
            first += rows
        return np.array(level_params, dtype=np.int64)


FeatureGradients = list[tuple[Tensor, Tensor]]
"""Points (n, 3) and what moves their features (n, l*f), of one backward pass after the other."""


class _Encode(torch.autograd.Function):
    """float32 on the CPU. `feature_gradients`, if given, takes what the table's gradient is made of in autograd's
    place.
    """

    @staticmethod
    def forward(
        ctx: Any, points: Tensor, table: Tensor, layout: GridLayout, feature_gradients: FeatureGradients | None
    ) -> Tensor:
        features = torch.empty(len(points), layout.width)
        arrays = (points.numpy(), table.detach().numpy(), layout.level_params, features.numpy())
        hashgrid_cpu.encode(*arrays, layout.lanes)
        ctx.save_for_backward(points, table)
        ctx.layout, ctx.feature_gradients = layout, feature_gradients
        return features

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        points, table = (saved.detach() for saved in ctx.saved_tensors)
        layout, feature_gradients = ctx.layout, ctx.feature_gradients
        nonzero_rows = torch.from_numpy(hashgrid_cpu.find_nonzero_rows(gradient.contiguous().numpy()))
        grad_features, positions = gradient.index_select(0, nonzero_rows), points.index_select(0, nonzero_rows)
        grad_points = None
        if ctx.needs_input_grad[0]:
            grad_selected = torch.zeros_like(positions)
            arrays = (
                positions.numpy(),
                table.numpy(),
                layout.level_params,
                grad_features.numpy(),
                grad_selected.numpy(),
            )
            hashgrid_cpu.add_points_gradient(*arrays, layout.lanes)
            grad_points = torch.zeros_like(points).index_copy_(0, nonzero_rows, grad_selected)
        if not ctx.needs_input_grad[1]:
            return grad_points, None, None, None
        if feature_gradients is not None:
            feature_gradients.append((positions, grad_features))
            return grad_points, None, None, None
        grad_table = torch.zeros_like(table)
        add_table_gradient_(grad_table, [(positions, grad_features)], layout)
        return grad_points, grad_table, None, None


def encode(
    points_unit: Float[Tensor, "n 3"],
    table: Float[Tensor, "rows f"],
    layout: GridLayout,
    feature_gradients: FeatureGradients | None = None,
) -> Float[Tensor, "n width"]:
    """Features of points in the unit box, level after level; differentiable in the points and the table.

    Points outside [0, 1] are read at the nearest point of the box. With `feature_gradients` (numba only), backward
    appends there
    what `add_table_gradient_` needs, and autograd gets no gradient of the table: a training step then neither allocates
    nor clears a table, and threads that go back at the same time do not write to one.
    """
    if not runs_on_numba(points_unit, table):
        return reference.encode(points_unit, table, layout.level_params)
    return _Encode.apply(points_unit.contiguous(), table, layout, feature_gradients)


def add_table_gradient_(
    grad_table: Float[Tensor, "rows f"], feature_gradients: FeatureGradients, layout: GridLayout
) -> None:
    """Add the table's gradient of these backward passes, in their order; threads are woken once for all of them."""
    if feature_gradients:
        points, grad_features = (torch.cat(parts).numpy() for parts in zip(*feature_gradients, strict=True))
        hashgrid_cpu.add_table_gradient(points, layout.level_params, grad_features, grad_table.numpy(), layout.lanes)
