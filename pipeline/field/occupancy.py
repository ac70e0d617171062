"""Occupancy grid of canonical space: 64^3 cells, one grid for all frames (Mueller et al. 2022, section 5.2).

The grid starts from the clothed A-pose body (`pipeline.field.initial_occupancy`). During the training the field's
density at a random point of each cell updates a decaying maximum of the opacity, and cells below a threshold become
empty. `pipeline.field.baselines.voxel_attention` has the update of IHM (Wang et al. 2025, section 2.2).

Letters: g cells per axis, n points, s samples of rays, e points that should be empty.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from pipeline.core.device import CPU
from pipeline.kernels.transmittance_stats import update_voxel_maxima

RESOLUTION = 64
INITIAL_EMA_RATIO = 3.0
"""Initial opacity of a cell, as a multiple of the threshold: with a decay of 0.95 a cell without density stays occupied
for about twenty updates.
"""
OBSERVATION_DECAY = 0.8
"""Factor of the recorded transmittances and weights at each update."""
MIN_UNOBSERVED_DISTANCE_M, MIN_ONE_SIDED_DISTANCE_M = 0.03, 0.015
"""Distance from the body, m, beyond which an unlit cell counts as unobserved, and a cell that is seen from one side."""
MIN_OBSERVED_TRANSMITTANCE = 0.02
"""Transmittance below which a cell counts as unlit: what is behind it contributes at most this much to a pixel."""


@dataclass(frozen=True)
class BinaryOccupancy:
    """Occupied cells (not zero) of a grid that fills the axis-aligned box `bounds_m` (low and high corner, m)."""

    occupied: UInt8[Tensor, "gx gy gz"]
    bounds_m: Float[Tensor, "2 3"]

    def to(self, device: torch.device) -> "BinaryOccupancy":
        """Return the same grid on another device."""
        return BinaryOccupancy(self.occupied.to(device), self.bounds_m.to(device))

    def occupied_bounds_m(self) -> Float[np.ndarray, "2 3"]:
        """Return the low and high corner of the box around all occupied cells, m; of the grid if there are none."""
        cells = torch.nonzero(self.occupied)
        if not len(cells):
            return self.bounds_m.cpu().numpy()
        cell_m = (self.bounds_m[1] - self.bounds_m[0]) / torch.tensor(self.occupied.shape, device=cells.device)
        corners = torch.stack([cells.amin(0), cells.amax(0) + 1])
        return (self.bounds_m[0] + corners * cell_m).cpu().numpy()

    def contains(self, points_m: Float[Tensor, "n 3"]) -> Tensor:
        """Return (n,) bool: whether each canonical point (m) is in an occupied cell."""
        size = torch.tensor(self.occupied.shape, device=points_m.device)
        index = ((points_m - self.bounds_m[0]) / (self.bounds_m[1] - self.bounds_m[0]) * size).floor().long()
        inside = ((index >= 0) & (index < size)).all(-1)
        index = torch.where(inside[:, None], index, 0)
        return inside & (self.occupied[tuple(index.unbind(-1))] != 0)


class CellData(NamedTuple):
    """Properties of all cells before the training.

    initially_occupied: cells that may ever be occupied. distance_m: signed distance to the body, negative inside.
    mask_fraction: fraction of the frames whose mask contains the cell, in [0, 1]. one_sided: cells that the camera sees
    from one side only. bounds_m: low and high corner of the grid.
    """

    initially_occupied: Bool[np.ndarray, "gx gy gz"]
    distance_m: Float[np.ndarray, "gx gy gz"]
    mask_fraction: Float[np.ndarray, "gx gy gz"]
    one_sided: Bool[np.ndarray, "gx gy gz"]
    bounds_m: Float[np.ndarray, "2 3"]


def cell_centres(bounds_m: Float[np.ndarray, "2 3"], resolution: int = RESOLUTION) -> Float[np.ndarray, "cells 3"]:
    """Return the centres (m) of all cells of a cubic grid, x slowest."""
    steps = (np.arange(resolution) + 0.5) / resolution
    unit = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    return (bounds_m[0] + unit * (bounds_m[1] - bounds_m[0])).astype(np.float32)


class OccupancyGrid:
    """State of the grid during the training; opacities are updated by a decaying maximum.

    Attributes hold flat cell indices (int64): `candidate_cells` may be occupied; `empty_cells` of the box are not
    occupied now; `unobserved` are occupied cells off the body which no frame confirms: no ray reached them with enough
    transmittance since the last updates, or all frames see them from one side. The density loss also pulls the density
    of unobserved cells towards zero. Otherwise cells between an arm and the torso keep their initial density and show
    when the arm is raised, and in a capture from the front density stays anywhere along the rays.
    """

    def __init__(self, cells: CellData, decay: float, threshold: float, device: torch.device = CPU) -> None:
        self.bounds_m = torch.tensor(cells.bounds_m, dtype=torch.float32, device=device)
        x, y, z = cells.initially_occupied.shape
        self.shape: tuple[int, int, int] = (x, y, z)
        candidates = np.flatnonzero(cells.initially_occupied)
        of_candidates = (
            array.reshape(-1)[candidates].astype(np.float32) for array in (cells.distance_m, cells.mask_fraction)
        )
        self.candidate_cells = torch.from_numpy(candidates).to(device)
        self.cell_m = (self.bounds_m[1] - self.bounds_m[0]) / torch.tensor(self.shape, device=device)
        self.cell_origins_m = torch.from_numpy(cell_centres(cells.bounds_m, x)).to(device) - 0.5 * self.cell_m
        self.distance_m, self.mask_fraction = (torch.from_numpy(array).to(device) for array in of_candidates)
        self.one_sided = torch.from_numpy(cells.one_sided.reshape(-1)[candidates]).to(device)
        self.opacity_ema = torch.full((len(candidates),), INITIAL_EMA_RATIO * threshold, device=device)
        maxima = torch.zeros(2, cells.initially_occupied.size, device=device)
        self.max_transmittance, self.max_weight = maxima.unbind()
        self.decay, self.threshold = decay, threshold
        self.occupied = torch.zeros(self.shape, dtype=torch.uint8, device=device)
        self.occupied.view(-1)[self.candidate_cells] = 1
        self.empty_cells = self._empty_cells()
        self.unobserved = self.candidate_cells[:0]

    def binary(self) -> BinaryOccupancy:
        """Return the occupied cells, without a copy: later updates change the result."""
        return BinaryOccupancy(self.occupied, self.bounds_m)

    def sample_empty_points(
        self, box_count: int, unobserved_count: int, rng: np.random.Generator
    ) -> Float[Tensor, "e 3"]:
        """Draw random points (m) where the density should be zero.

        They are the part of `box_count` points of the box that falls in empty cells, and `unobserved_count` points of
        unobserved cells if there are any.
        """
        in_empty = round(box_count * len(self.empty_cells) / self.occupied.numel())
        requests = ((self.empty_cells, in_empty), (self.unobserved, unobserved_count if len(self.unobserved) else 0))
        drawn = [cells[self._to_device(rng.integers(0, max(len(cells), 1), count))] for cells, count in requests]
        return self.sample_in_cells(torch.cat(drawn), rng)

    def sample_in_cells(self, cells: Int[Tensor, "n"], rng: np.random.Generator) -> Float[Tensor, "n 3"]:
        """Draw a random point (m) in each cell; `cells` are flat indices."""
        inside = self._to_device(rng.random((len(cells), 3), dtype=np.float32))
        return self.cell_origins_m.index_select(0, cells) + inside * self.cell_m

    def record_observations(
        self, points_m: Float[Tensor, "s 3"], transmittance: Float[Tensor, "s"], weights: Float[Tensor, "s"]
    ) -> None:
        """Record for each sample's cell the largest transmittance and the largest weight in a pixel."""
        update_voxel_maxima(
            points_m, transmittance, weights, self.bounds_m, self.shape, self.max_transmittance, self.max_weight
        )

    def parameters(self) -> dict[str, Tensor]:
        """Return the parameters of the update rule that the optimiser trains, by name: none."""
        return {}

    def gate(self) -> Float[Tensor, "gx gy gz"] | None:
        """Return the factor of the density of each voxel, as a leaf of autograd; None: there are no factors."""
        return None

    def parameter_gradients(self, gate_gradient: Float[Tensor, "gx gy gz"]) -> dict[str, Tensor]:
        """Return the gradients of `parameters`, from that of `gate`."""
        raise TypeError(f"{type(self).__name__} has no gate, so it has no gradient either")

    @torch.no_grad()
    def update(self, density_fn: Callable[[Tensor], Tensor], step_m: float, rng: np.random.Generator) -> None:
        """Update the opacity of all candidate cells from the density at a random point of each.

        density_fn: maps canonical points (n, 3), m, to densities (n,), 1/m.
        step_m: length over which a density becomes an opacity, m.
        """
        density_per_m = density_fn(self.sample_in_cells(self.candidate_cells, rng))
        self._update_opacity(density_per_m, -torch.expm1(-density_per_m * step_m))
        kept = self.opacity_ema > min(self.threshold, float(self.opacity_ema.mean()))
        self.occupied.view(-1)[self.candidate_cells] = kept.to(torch.uint8)
        self.max_transmittance *= OBSERVATION_DECAY
        self.max_weight *= OBSERVATION_DECAY
        unlit = self.max_transmittance[self.candidate_cells] < MIN_OBSERVED_TRANSMITTANCE
        min_distance_m = torch.where(self.one_sided, MIN_ONE_SIDED_DISTANCE_M, MIN_UNOBSERVED_DISTANCE_M)
        self.unobserved = self.candidate_cells[kept & (unlit | self.one_sided) & (self.distance_m > min_distance_m)]
        self.empty_cells = self._empty_cells()

    def _update_opacity(self, density_per_m: Float[Tensor, "n"], opacity: Float[Tensor, "n"]) -> None:
        """Update `opacity_ema` of the candidate cells: a maximum that decays (Instant-NGP)."""
        self.opacity_ema = torch.maximum(self.opacity_ema * self.decay, opacity)

    def _empty_cells(self) -> Int[Tensor, "e"]:
        return torch.nonzero(self.occupied.view(-1) == 0)[:, 0]

    def _to_device(self, array: np.ndarray) -> Tensor:
        return torch.from_numpy(array).to(self.candidate_cells.device)

    def state_dict(self) -> dict[str, Tensor]:
        """Return all tensors that a resumed training needs."""
        return {
            "opacity_ema": self.opacity_ema,
            "max_transmittance": self.max_transmittance,
            "max_weight": self.max_weight,
            "occupied": self.occupied,
            "unobserved": self.unobserved,
        }

    def load_state_dict(self, tensors: dict[str, Tensor]) -> None:
        """Restore the state that `state_dict` returned."""
        for name in ("opacity_ema", "max_transmittance", "max_weight", "unobserved"):
            setattr(self, name, tensors[name].clone().to(self.candidate_cells.device))
        self.occupied.copy_(tensors["occupied"])
        self.empty_cells = self._empty_cells()
