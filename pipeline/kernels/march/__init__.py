"""Ray marching: where along each ray the canonical field has to be asked.

Each ray walks through the posed box of its own frame in steps of constant length in metres; each stop is looked up
in the frame's warp grid, and kept if its canonical point lies in an occupied cell. What is kept is packed, ray after
ray.

Letters: n rays, s samples, k frames.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from pipeline.kernels.common.dispatch import runs_on_numba
from pipeline.kernels.inverse_skinning import WarpGrid
from pipeline.kernels.march import cpu as march_cpu
from pipeline.kernels.march import reference


@dataclass(frozen=True)
class PackedWarpGrids:
    """The warp grids of several frames, one behind the other, all with the same cell.

    A frame is a row of `origin_m` and `dims`; `offsets` says where its nodes, cells and maps begin.
    """

    cell_m: float
    origin_m: Float[Tensor, "k 3"]
    dims: Int[Tensor, "k 3"]
    offsets: Int[Tensor, "k 3"]
    canonical_m: Float[Tensor, "nodes 3"]
    cell_codes: Int[Tensor, "cells"]
    affine_maps: Float[Tensor, "maps 12"]

    @staticmethod
    def of(grids: Sequence[WarpGrid], cell_m: float) -> "PackedWarpGrids":
        """Lay warp grids one behind the other; `cell_m` is the cell of all of them."""
        sizes = np.array([(len(g.canonical_m), len(g.cell_codes), len(g.affine_maps)) for g in grids], dtype=np.int64)
        names = ("canonical_m", "cell_codes", "affine_maps")
        joined = {name: np.concatenate([getattr(grid, name) for grid in grids]) for name in names}
        joined |= {name: np.stack([getattr(grid, name) for grid in grids]) for name in ("origin_m", "dims")}
        joined["offsets"] = np.cumsum(sizes, axis=0) - sizes
        return PackedWarpGrids(cell_m, **{name: torch.from_numpy(array) for name, array in joined.items()})

    def to(self, device: torch.device) -> "PackedWarpGrids":
        """The same grids on another device."""
        return PackedWarpGrids(self.cell_m, *(tensor.to(device) for tensor in self.tensors()))

    def tensors(self) -> tuple[Tensor, ...]:
        """In the order that the loops and their twin take."""
        return self.origin_m, self.dims, self.offsets, self.canonical_m, self.cell_codes, self.affine_maps


@dataclass(frozen=True)
class Samples:
    """Packed samples: canonical position, distance along the ray (m), and where each ray's samples begin (n + 1)."""

    canonical_m: Float[Tensor, "s 3"]
    distance_m: Float[Tensor, "s"]
    ray_offsets: Int[Tensor, "m"]


def march(
    origins_m: Float[Tensor, "n 3"],
    directions: Float[Tensor, "n 3"],
    frame: Int[Tensor, "n"],
    jitter: Float[Tensor, "n"],
    step_m: float,
    warps: PackedWarpGrids,
    occupied: UInt8[Tensor, "gx gy gz"],
    bounds_m: Float[Tensor, "2 3"],
    max_samples: int = 160,
) -> Samples:
    """Samples of rays, given in the posed space of their frame, inside occupied cells.

    Args:
        directions: unit length.
        frame: row of `warps` that each ray belongs to, int64.
        jitter: in [0, 1), the part of a step by which a ray's stops are shifted.
        occupied: not zero where the canonical field may hold something; the grid fills the box `bounds_m`.
        max_samples: a ray's samples beyond that number are dropped.

    A stop in a posed cell with several inverses gives a sample for each of them that is occupied, at the same distance.
    """
    if not runs_on_numba(origins_m, directions, jitter):
        return Samples(
            *reference.march(
                origins_m,
                directions,
                frame,
                jitter,
                step_m,
                warps.cell_m,
                warps.tensors(),
                occupied,
                bounds_m,
                max_samples,
            )
        )
    arrays = (tensor.contiguous().numpy() for tensor in (origins_m, directions, frame, jitter))
    grids = (tensor.numpy() for tensor in (*warps.tensors(), occupied, bounds_m))
    points, distance, ray_offsets = march_cpu.march(
        *arrays, np.float32(step_m), np.float32(warps.cell_m), *grids, max_samples
    )
    return Samples(torch.from_numpy(points), torch.from_numpy(distance), torch.from_numpy(ray_offsets))
