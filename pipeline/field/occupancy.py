"""Which cells of canonical space may hold something: 64³ voxels, one grid for the whole sequence.

IHM (Wang et al. 2025), section 2.2: starts from the A-posed body, and is updated by a moving average of the field's
density, weighted by voxel attention, a two-layer network on density, distance to the body surface and frequency over
time. The paper does not say how that network learns. Here it learns from what the training rays saw: a voxel that
light reached is an example, positive if it gave weight to a pixel, negative if the light went through. Voxels that
no light reached (the inside of the body) give no example and are judged by what the network learnt from the others.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from pipeline.core.device import CPU
from pipeline.kernels.transmittance_stats import update_voxel_maxima

RESOLUTION = 64
ATTENTION_HIDDEN_WIDTH = 16
INITIAL_EMA_RATIO = 3.0
"""The average of a cell before it was asked, in thresholds: with a decay of 0.95 it stays occupied for some twenty
updates in which its density is zero.
"""
OBSERVATION_DECAY = 0.8
"""What is left, an update later, of what the rays saw in a cell."""
MIN_UNOBSERVED_DISTANCE_M, MIN_ONE_SIDED_DISTANCE_M = 0.03, 0.015
"""Clothing nearer to the body than the first needs no evidence, where one side alone is filmed than the second."""
MIN_OBSERVED_TRANSMITTANCE = 0.02
"""Light below which a cell counts as unlit; what is behind it gives a pixel at most so much."""


@dataclass(frozen=True)
class BinaryOccupancy:
    """Occupied cells (not zero) of a grid that fills the box `bounds_m`."""

    occupied: UInt8[Tensor, "gx gy gz"]
    bounds_m: Float[Tensor, "2 3"]

    def to(self, device: torch.device) -> "BinaryOccupancy":
        """The same grid on another device."""
        return BinaryOccupancy(self.occupied.to(device), self.bounds_m.to(device))

    def contains(self, points_m: Float[Tensor, "n 3"]) -> Tensor:
        """True for each canonical point in an occupied cell."""
        size = torch.tensor(self.occupied.shape, device=points_m.device)
        index = ((points_m - self.bounds_m[0]) / (self.bounds_m[1] - self.bounds_m[0]) * size).floor().long()
        inside = ((index >= 0) & (index < size)).all(-1)
        index = torch.where(inside[:, None], index, 0)
        return inside & (self.occupied[tuple(index.unbind(-1))] != 0)


def cell_centres(bounds_m: Float[np.ndarray, "2 3"], resolution: int = RESOLUTION) -> Float[np.ndarray, "cells 3"]:
    """Centres (m) of the cells, x slowest."""
    steps = (np.arange(resolution) + 0.5) / resolution
    unit = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    return (bounds_m[0] + unit * (bounds_m[1] - bounds_m[0])).astype(np.float32)


class VoxelAttention(torch.nn.Module):
    """(density, distance, frequency) -> weight in [0, 1]; near one before it has learnt anything."""

    def __init__(self, clothing_offset_m: float, seed: int) -> None:
        super().__init__()
        self.clothing_offset_m = clothing_offset_m
        random = torch.Generator().manual_seed(seed)
        self.first = torch.nn.Linear(3, ATTENTION_HIDDEN_WIDTH)
        self.second = torch.nn.Linear(ATTENTION_HIDDEN_WIDTH, 1)
        for weight in (self.first.weight, self.second.weight):
            weight.data.uniform_(-0.6, 0.6, generator=random)
        self.first.bias.data.zero_()
        self.second.bias.data.fill_(2.0)

    def forward(
        self, density_per_m: Float[Tensor, "n"], distance_m: Float[Tensor, "n"], mask_fraction: Float[Tensor, "n"]
    ) -> Float[Tensor, "n"]:
        """Logit of the weight. density >= 0; distance negative inside the body; frequency in [0, 1]."""
        inputs = torch.stack(
            [0.5 * torch.log1p(density_per_m) - 1, distance_m / self.clothing_offset_m, 2 * mask_fraction - 1], dim=-1
        )
        return self.second(torch.relu(self.first(inputs))).squeeze(-1)


class OccupancyGrid:
    """The state that changes while the field learns: moving average, what rays saw, and the attention network.

    By flat index, cells: those that may ever be occupied. empty: all of the box that are not occupied now. unproven:
    occupied cells off the body of which no frame says whether they hold something: no light had reached them when they
    were last updated, or only one side of them is ever filmed. They are asked to be empty too. Else what is between an
    arm and the torso that it never left keeps the density that it began with, and becomes a flap of cloth once the arm
    is lifted; and what is filmed from the front alone lies anywhere along the rays that saw it.
    """

    def __init__(
        self,
        initially_occupied: Bool[np.ndarray, "gx gy gz"],
        distance_m: Float[np.ndarray, "gx gy gz"],
        mask_fraction: Float[np.ndarray, "gx gy gz"],
        one_sided: Bool[np.ndarray, "gx gy gz"],
        bounds_m: Float[np.ndarray, "2 3"],
        clothing_offset_m: float,
        attention: bool,
        learning_rate: float,
        decay: float,
        threshold: float,
        seed: int,
        device: torch.device = CPU,
    ) -> None:
        self.bounds_m = torch.tensor(bounds_m, dtype=torch.float32, device=device)
        x, y, z = initially_occupied.shape
        self.shape: tuple[int, int, int] = (x, y, z)
        cells = np.flatnonzero(initially_occupied)
        of_cells = (array.reshape(-1)[cells].astype(np.float32) for array in (distance_m, mask_fraction))
        self.cells = torch.from_numpy(cells).to(device)
        self.cell_m = (self.bounds_m[1] - self.bounds_m[0]) / torch.tensor(self.shape, device=device)
        self.cell_origins_m = (
            torch.from_numpy(cell_centres(bounds_m, initially_occupied.shape[0])).to(device) - 0.5 * self.cell_m
        )
        self.distance_m, self.mask_fraction = (torch.from_numpy(array).to(device) for array in of_cells)
        self.one_sided = torch.from_numpy(one_sided.reshape(-1)[cells]).to(device)
        self.opacity_ema = torch.full((len(cells),), INITIAL_EMA_RATIO * threshold, device=device)
        self.max_transmittance, self.max_weight = torch.zeros(2, initially_occupied.size, device=device).unbind()
        self.decay, self.threshold = decay, threshold
        self.attention = VoxelAttention(clothing_offset_m, seed).to(device) if attention else None
        if self.attention is not None:
            self.optimiser = torch.optim.Adam(self.attention.parameters(), lr=learning_rate)
        self.occupied = torch.zeros(initially_occupied.shape, dtype=torch.uint8, device=device)
        self.occupied.view(-1)[self.cells] = 1
        self.empty = self._empty_cells()
        self.unobserved = self.cells[:0]

    def grid(self) -> BinaryOccupancy:
        """The cells as they are occupied now; later updates show in it."""
        return BinaryOccupancy(self.occupied, self.bounds_m)

    def sample_empty_points(
        self, box_count: int, unobserved_count: int, random: np.random.Generator
    ) -> Float[Tensor, "e 3"]:
        """Random points where nothing should be: those of `box_count` points of the box that come to lie in empty
        cells,
        and `unobserved_count` of unproven cells, if there are any.
        """
        in_empty = round(box_count * len(self.empty) / self.occupied.numel())
        requests = ((self.empty, in_empty), (self.unobserved, unobserved_count if len(self.unobserved) else 0))
        drawn = [cells[self._to_device(random.integers(0, max(len(cells), 1), count))] for cells, count in requests]
        return self.sample_in_cells(torch.cat(drawn), random)

    def sample_in_cells(self, cells: Int[Tensor, "n"], random: np.random.Generator) -> Float[Tensor, "n 3"]:
        """A random point (m) of each cell, given by flat index."""
        inside = self._to_device(random.random((len(cells), 3), dtype=np.float32))
        return self.cell_origins_m.index_select(0, cells) + inside * self.cell_m

    def _empty_cells(self) -> Int[Tensor, "e"]:
        return torch.nonzero(self.occupied.view(-1) == 0)[:, 0]

    def _to_device(self, array: np.ndarray) -> Tensor:
        return torch.from_numpy(array).to(self.cells.device)

    def record_observations(
        self, points_m: Float[Tensor, "s 3"], transmittance: Float[Tensor, "s"], weights: Float[Tensor, "s"]
    ) -> None:
        """Note for each sample's cell how much light reached it and how much of a pixel it gave."""
        update_voxel_maxima(
            points_m, transmittance, weights, self.bounds_m, self.shape, self.max_transmittance, self.max_weight
        )

    @torch.no_grad()
    def update(self, density_fn: Callable[[Tensor], Tensor], step_m: float, random: np.random.Generator) -> None:
        """One update of all cells of the shell.

        density_of: canonical points (n, 3) -> density (n); asked at a random point of each cell.
        step_m: length over which a density becomes an opacity.
        """
        density = density_fn(self.sample_in_cells(self.cells, random))
        opacity = -torch.expm1(-density * step_m)
        if self.attention is None:
            self.opacity_ema = torch.maximum(self.opacity_ema * self.decay, opacity)
        else:
            weight = torch.sigmoid(self._train_attention(self.attention, density))
            self.opacity_ema = self.decay * self.opacity_ema + (1 - self.decay) * weight * opacity
        kept = self.opacity_ema > min(self.threshold, float(self.opacity_ema.mean()))
        self.occupied.view(-1)[self.cells] = kept.to(torch.uint8)
        self.max_transmittance *= OBSERVATION_DECAY
        self.max_weight *= OBSERVATION_DECAY
        unlit = self.max_transmittance[self.cells] < MIN_OBSERVED_TRANSMITTANCE
        min_distance_m = torch.where(self.one_sided, MIN_ONE_SIDED_DISTANCE_M, MIN_UNOBSERVED_DISTANCE_M)
        self.unobserved = self.cells[kept & (unlit | self.one_sided) & (self.distance_m > min_distance_m)]
        self.empty = self._empty_cells()

    def _train_attention(self, attention: VoxelAttention, density: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
        """One step of the attention network on the cells that light reached lately; returns the logits of all cells."""
        max_transmittance, max_weight = self.max_transmittance[self.cells], self.max_weight[self.cells]
        seen = (max_transmittance > 0.25).float()
        target = (max_weight / 0.05).clamp(max=1)
        with torch.enable_grad():
            logit = attention(density, self.distance_m, self.mask_fraction)
            loss = torch.nn.functional.binary_cross_entropy_with_logits(logit, target, seen, reduction="sum")
            self.optimiser.zero_grad()
            (loss / seen.sum().clamp(min=1)).backward()
            self.optimiser.step()
        return logit.detach()

    def state(self) -> dict[str, Tensor]:
        """Everything that a resumed run needs."""
        tensors = {
            "opacity_ema": self.opacity_ema,
            "max_transmittance": self.max_transmittance,
            "max_weight": self.max_weight,
            "occupied": self.occupied,
        }
        tensors["unobserved"] = self.unobserved
        if self.attention is None:
            return tensors
        for name, parameter in self.attention.named_parameters():
            moments = self.optimiser.state.get(parameter, {})
            tensors[f"attention.{name}"] = parameter.detach()
            tensors |= {f"attention.{name}.{key}": value for key, value in moments.items()}
        return tensors

    def load_state(self, tensors: dict[str, Tensor]) -> None:
        """Go on from `state()`."""
        for name in ("opacity_ema", "max_transmittance", "max_weight", "unobserved"):
            setattr(self, name, tensors[name].clone().to(self.cells.device))
        self.occupied.copy_(tensors["occupied"])
        self.empty = self._empty_cells()
        if self.attention is None:
            return
        for name, parameter in self.attention.named_parameters():
            parameter.data.copy_(tensors[f"attention.{name}"])
            keys = [key for key in ("step", "exp_avg", "exp_avg_sq") if f"attention.{name}.{key}" in tensors]
            if keys:
                kept = {key: tensors[f"attention.{name}.{key}"].clone() for key in keys}
                # The count of steps stays on the CPU, as torch's Adam keeps it.
                moved = {key: kept[key].to(parameter.device) for key in keys if key != "step"}
                self.optimiser.state[parameter] = kept | moved
