"""Multi-resolution hash grid: features of points, interpolated trilinearly in several grids at once.

Müller et al. 2022, "Instant Neural Graphics Primitives", section 3. Notation: n points, l levels, f features.

Two differences from the paper, both measured (docs/decisions/field.md): the cells of a level are cubes in metres, so
the number of cells is set for each axis and a standing body wastes no table rows on the empty half of a cube; levels
whose nodes fit in the table are dense and have no collisions.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.kernels.common.dispatch import runs_on_cuda, runs_on_numba
from pipeline.kernels.hashgrid import cpu, reference
from pipeline.kernels.hashgrid.cpu import HashTable

SUPPORTED_FEATURE_COUNTS = (1, 2, 4, 8)


@dataclass(frozen=True)
class GridLayout:
    """Layout of the rows of all levels in one table.

    cells_per_axis: number of cells (x, y, z) of each level, coarse to fine.
    features: floats of each row, one of `SUPPORTED_FEATURE_COUNTS`.
    log2_rows: a level has at most 2**log2_rows rows.

    Raises ValueError for an unsupported number of features.
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
        """Number of features of an encoded point, of all levels."""
        return self.levels * self.features

    @cached_property
    def rows_per_level(self) -> tuple[int, ...]:
        """Table rows of each level: one for each node (dense), or 2**`log2_rows` that nodes share (hashed)."""
        limit = 1 << self.log2_rows
        return tuple(min(limit, (x + 1) * (y + 1) * (z + 1)) for x, y, z in self.cells_per_axis)

    @cached_property
    def rows(self) -> int:
        """Rows of the whole table."""
        return sum(self.rows_per_level)

    @cached_property
    def level_params(self) -> np.ndarray:
        """(l, 6) int64: cells along x, y, z; first row; number of rows; 1 if the level is dense, else 0."""
        level_params, first = [], 0
        for (x, y, z), rows in zip(self.cells_per_axis, self.rows_per_level, strict=True):
            level_params.append((x, y, z, first, rows, int((x + 1) * (y + 1) * (z + 1) <= rows)))
            first += rows
        return np.array(level_params, dtype=np.int64)

    def arrays(self, table: Float[Tensor, "rows f"]) -> HashTable:
        """Return a table, or its gradient, for the compiled loops; it is on the CPU."""
        return HashTable(table.detach().numpy(), self.level_params)

    @property
    def lanes(self) -> tuple[int, ...]:
        """A tuple with one element for each feature, whose type tells the compiled loops the number of features."""
        return (0,) * self.features


FeatureGradients = list[tuple[Tensor, Tensor]]
"""Points (n, 3) and the gradients of their features (n, l*f), one pair for each backward pass."""


class _Encode(torch.autograd.Function):
    """Hash encoding in float32 on the CPU.

    If `feature_gradients` is not None, the backward pass appends the gradients of the features to it instead of
    returning the gradient of the table.
    """

    @staticmethod
    def forward(
        ctx: Any, points: Tensor, table: Tensor, layout: GridLayout, feature_gradients: FeatureGradients | None
    ) -> Tensor:
        features = torch.empty(len(points), layout.width)
        cpu.encode(points.numpy(), layout.arrays(table), layout.lanes, features.numpy())
        ctx.save_for_backward(points, table)
        ctx.layout, ctx.feature_gradients = layout, feature_gradients
        return features

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        points, table = (saved.detach() for saved in ctx.saved_tensors)
        layout, feature_gradients = ctx.layout, ctx.feature_gradients
        nonzero_rows = torch.from_numpy(cpu.find_nonzero_rows(gradient.contiguous().numpy()))
        grad_features, positions = gradient.index_select(0, nonzero_rows), points.index_select(0, nonzero_rows)
        grad_points = None
        if ctx.needs_input_grad[0]:
            grad_selected = torch.zeros_like(positions)
            cpu.add_points_gradient(
                positions.numpy(), layout.arrays(table), layout.lanes, grad_features.numpy(), grad_selected.numpy()
            )
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
    """Encode points of the unit box, level after level; differentiable in the points and the table.

    Points outside [0, 1] are clamped to the box.

    Args:
        feature_gradients: if not None (numba only), the backward pass appends the input of `add_table_gradient_` to
            this list, and autograd gets no gradient of the table. A training step then neither allocates nor clears a
            table, and parallel backward passes do not write to the same table.
    """
    if runs_on_cuda(points_unit, table) and not torch.is_grad_enabled():
        from pipeline.kernels.hashgrid import cuda  # only where there is a GPU

        return cuda.encode(points_unit.contiguous(), table, layout.level_params)
    if not runs_on_numba(points_unit, table):
        return reference.encode(points_unit, table, layout.level_params)
    return _Encode.apply(points_unit.contiguous(), table, layout, feature_gradients)


def add_table_gradient_(
    grad_table: Float[Tensor, "rows f"], feature_gradients: FeatureGradients, layout: GridLayout
) -> None:
    """Add the gradient of the table, summed over backward passes in their order, to `grad_table` in place.

    One call for all passes starts the parallel threads only once.
    """
    if not feature_gradients:
        return
    points, grad_features = (torch.cat(parts) for parts in zip(*feature_gradients, strict=True))
    if runs_on_cuda(grad_table, points):
        from pipeline.kernels.hashgrid import cuda  # only where there is a GPU

        cuda.add_table_gradient(points, grad_features, grad_table, layout.level_params)
    else:
        cpu.add_table_gradient(points.numpy(), grad_features.numpy(), layout.arrays(grad_table), layout.lanes)
