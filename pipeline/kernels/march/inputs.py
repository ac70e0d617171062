"""Inputs of ray marching: rays, warp grids of several frames, and the volume that rays are sampled in.

Notation: n rays, k frames.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from pipeline.kernels.inverse_skinning import WarpGrid
from pipeline.kernels.march.cpu import OccupancyArrays, WarpArrays

_PACKED: dict[str, tuple[type, tuple[int, ...]]] = {
    "canonical_m": (np.float32, (3,)),
    "cell_codes": (np.int32, ()),
    "affine_maps": (np.float32, (12,)),
}
"""Type and size of the rows of the arrays that differ in length from grid to grid."""


class Rays(NamedTuple):
    """Rays, each in the posed space of its frame.

    directions: unit length. frame_index: row of the warp grids (int64). jitter: offset of the samples of each ray, as a
    fraction of a step, in [0, 1).
    """

    origins_m: Float[Tensor, "n 3"]
    directions: Float[Tensor, "n 3"]
    frame_index: Int[Tensor, "n"]
    jitter: Float[Tensor, "n"]


@dataclass(frozen=True)
class PackedWarpGrids:
    """The warp grids of several frames, concatenated; all have the same cell size.

    Rows of `origin_m` and `dims` are frames; `offsets` holds the first node, cell and affine map of each frame.
    """

    cell_m: float
    origin_m: Float[Tensor, "k 3"]
    dims: Int[Tensor, "k 3"]
    offsets: Int[Tensor, "k 3"]
    canonical_m: Float[Tensor, "nodes 3"]
    cell_codes: Int[Tensor, "cells"]
    affine_maps: Float[Tensor, "maps 12"]

    @staticmethod
    def from_grids(grids: Iterable[WarpGrid], cell_m: float) -> "PackedWarpGrids":
        """Concatenate warp grids, all with cells of `cell_m`; at least one.

        The arrays grow in place, so that grids that come from an iterator are not all in memory twice.
        """
        first = []
        joined: dict[str, np.ndarray] = {name: np.zeros((0, *tail), dtype) for name, (dtype, tail) in _PACKED.items()}
        origins, dims = [], []
        for grid in grids:
            first.append([len(array) for array in joined.values()])
            origins.append(grid.origin_m)
            dims.append(grid.dims)
            for name, array in joined.items():
                part = getattr(grid, name)
                array.resize((len(array) + len(part), *part.shape[1:]), refcheck=False)
                array[len(array) - len(part) :] = part
        packed = joined | {"origin_m": np.stack(origins), "dims": np.stack(dims), "offsets": np.array(first, np.int64)}
        return PackedWarpGrids(cell_m, **{name: torch.from_numpy(array) for name, array in packed.items()})

    def tensors(self) -> tuple[Tensor, ...]:
        """Return all tensors, in the order of the fields."""
        return self.origin_m, self.dims, self.offsets, self.canonical_m, self.cell_codes, self.affine_maps

    def to(self, device: torch.device) -> "PackedWarpGrids":
        """Return the grids on another device."""
        return PackedWarpGrids(self.cell_m, *(tensor.to(device) for tensor in self.tensors()))

    @cached_property
    def arrays(self) -> WarpArrays:
        """The grids for the compiled loops; they are on the CPU."""
        return WarpArrays(np.float32(self.cell_m), *(tensor.contiguous().numpy() for tensor in self.tensors()))


@dataclass(frozen=True)
class SamplingVolume:
    """The volume that rays are sampled in: inverse skinning of the frames, and the occupied cells of canonical space.

    occupied: nonzero where the field may have density; the grid fills the box `bounds_m` (low and high corner).
    """

    warps: PackedWarpGrids
    occupied: UInt8[Tensor, "gx gy gz"]
    bounds_m: Float[Tensor, "2 3"]

    @cached_property
    def occupancy_arrays(self) -> OccupancyArrays:
        """The occupancy grid for the compiled loops; it is on the CPU."""
        low_m, high_m = self.bounds_m
        cells_per_m = torch.tensor(self.occupied.shape) / (high_m - low_m)
        return OccupancyArrays(*(tensor.contiguous().numpy() for tensor in (self.occupied, low_m, cells_per_m)))
