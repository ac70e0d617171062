"""Inverse skinning: from posed points back to the canonical A-pose.

A `SkinGrid` holds skin weights at the nodes near the canonical body. For one frame, `bake_warp_grid` inverts the
skinning at the nodes of a posed grid (`WarpGrid`). A lookup in that grid and at most one Newton step (`newton_step`)
replace the Broyden search from 13 bones of SNARF and InstantAvatar (Chen et al. 2021, Jiang et al. 2023). Where limbs
come near each other, a posed cell has several inverses; it then holds one affine map for each.

Notation: m nodes of the skin grid, j joints, k frames of a batch, s samples.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from pipeline.kernels.blend import SparseWeights, blend
from pipeline.kernels.common.dispatch import runs_on_numba
from pipeline.kernels.common.packing import segment_ids_from_counts
from pipeline.kernels.inverse_skinning import cell_skinning_cpu, cpu, newton_cpu, reference
from pipeline.kernels.inverse_skinning.cell_skinning_cpu import CellWeights
from pipeline.kernels.inverse_skinning.cpu import PosedGrid, SkinArrays
from pipeline.kernels.inverse_skinning.newton_cpu import LatticeArrays
from pipeline.kernels.inverse_skinning.reference import Lattice

if TYPE_CHECKING:
    from pipeline.kernels.inverse_skinning.cuda import CellTensors


@dataclass(frozen=True)
class SkinGrid:
    """Skin weights near the canonical body, interpolated trilinearly between nodes with spacing `cell_m`.

    row_of_node: row of each lattice node in the arrays of the m nodes that exist, -1 for the others.
    distance_m: distance of each node to the body surface.
    """

    origin_m: Float[Tensor, "3"]
    cell_m: float
    row_of_node: Int[Tensor, "gx gy gz"]
    nodes_m: Float[Tensor, "m 3"]
    distance_m: Float[Tensor, "m"]
    weights: Float[Tensor, "m j"]

    @property
    def lattice(self) -> Lattice:
        """Positions of the nodes, for `pipeline.kernels.inverse_skinning.reference`."""
        return Lattice(self.origin_m, self.cell_m, self.row_of_node)

    def lattice_arrays(self) -> LatticeArrays:
        """Return the positions of the nodes for the compiled loops; the grid is on the CPU."""
        return LatticeArrays(self.origin_m.numpy(), np.float32(self.cell_m), self.row_of_node.numpy())

    def to(self, device: torch.device) -> "SkinGrid":
        """Return the grid on another device; the same object if it is already there."""
        if self.weights.device == device:
            return self
        moved = (tensor.to(device) for tensor in (self.row_of_node, self.nodes_m, self.distance_m, self.weights))
        return SkinGrid(self.origin_m.to(device), self.cell_m, *moved)

    def blend(self, canonical_to_posed: Float[Tensor, "k j 4 4"]) -> Float[Tensor, "m k 12"]:
        """Return the blended skinning matrices (upper 3 x 4 part, row by row) at every node, in one product."""
        by_joint = canonical_to_posed[:, :, :3].transpose(0, 1).flatten(1)
        return blend(self.sparse_weights, by_joint).view(-1, len(canonical_to_posed), 12)

    @cached_property
    def sparse_weights(self) -> SparseWeights:
        """The nonzero weights: a node has two or three joints."""
        return SparseWeights.from_dense(self.weights)

    @cached_property
    def cell_weights(self) -> CellWeights:
        """The nonzero weights by cell, for the compiled loops; the grid is on the CPU."""
        node_weights, row_of_node = (tensor.numpy() for tensor in self.sparse_weights), self.row_of_node.numpy()
        cells = cell_skinning_cpu.weights_by_cell(row_of_node, *node_weights, self.weights.shape[1])
        return CellWeights(self.origin_m.numpy(), np.float32(self.cell_m), *cells)

    @cached_property
    def cuda_cell_weights(self) -> "CellTensors":
        """The nonzero weights by cell, as tensors on the device of the grid, for CUDA kernels."""
        from pipeline.kernels.inverse_skinning import cuda  # only where there is a GPU

        return cuda.cells_on(self.weights.device, self.to(torch.device("cpu")).cell_weights)

    def crop_to_occupied(self, occupied: UInt8[Tensor, "ox oy oz"], bounds_m: Float[Tensor, "2 3"]) -> "SkinGrid":
        """Return the grid with only the nodes that some point of an occupied cell is interpolated from.

        occupied: nonzero for occupied cells; the cells fill the box `bounds_m`.
        """
        wanted, device = (occupied != 0).float(), occupied.device
        low_m, high_m = bounds_m.double()
        for axis, (nodes, cells) in enumerate(zip(self.row_of_node.shape, occupied.shape, strict=True)):
            at_m = self.origin_m[axis] + torch.arange(nodes, device=device).double()[:, None] * self.cell_m
            part = torch.arange(cells + 1, device=device).double() / cells
            edges_m = low_m[axis] + part * (high_m[axis] - low_m[axis])
            # Nodes that are corners of a grid cell that intersects each layer of occupied cells.
            meets = (edges_m[:-1] <= at_m + self.cell_m) & (edges_m[1:] >= at_m - self.cell_m)
            wanted = torch.tensordot(meets.float(), wanted, dims=([1], [axis])).movedim(0, axis)
        kept = (wanted > 0) & (self.row_of_node >= 0)
        rows = self.row_of_node[kept].long()
        row_of_node = torch.full_like(self.row_of_node, -1)
        row_of_node[kept] = torch.arange(len(rows), device=device).to(row_of_node)
        nodes_m, distance_m, weights = (x.index_select(0, rows) for x in (self.nodes_m, self.distance_m, self.weights))
        return SkinGrid(self.origin_m, self.cell_m, row_of_node, nodes_m, distance_m, weights)

    def interpolate_weights(self, points_m: Float[Tensor, "n 3"]) -> Float[Tensor, "n j"]:
        """Interpolate skin weights at canonical points; outside the grid use the nearest node that exists."""
        return reference.interpolate(points_m, self.lattice, self.weights.to(points_m))


@dataclass(frozen=True)
class WarpGrid:
    """Inverse skinning of one frame on a posed grid with the cell size of the skin grid.

    canonical_m: canonical position of each node, NaN where unknown (x slowest, z fastest).
    cell_codes: one code for each cell. -1: no inverse. 0: one smooth inverse, to be interpolated.
        1 + 4 * first + (count - 1): `count` inverses, rows first .. first + count - 1 of `affine_maps`.
    affine_maps: maps from posed to canonical space, 3 x 4 row by row.
    """

    origin_m: Float[np.ndarray, "3"]
    dims: Int[np.ndarray, "3"]
    canonical_m: Float[np.ndarray, "nodes 3"]
    cell_codes: Int[np.ndarray, "cells"]
    affine_maps: Float[np.ndarray, "maps 12"]


def bake_warp_grid(skin: SkinGrid, canonical_to_posed: Float[Tensor, "j 4 4"]) -> WarpGrid:
    """Invert the skinning of one frame; `skin` is on the CPU.

    Releases the GIL, so that several threads can bake different frames.
    """
    # A dense product: `SkinGrid.blend` has a parallel loop, which only one thread may enter.
    matrices = canonical_to_posed.detach().float().cpu()[:, :3].flatten(1)
    blended = (skin.weights @ matrices)[:, None].numpy()
    skin_arrays = SkinArrays(skin.lattice_arrays(), skin.nodes_m.numpy(), skin.distance_m.numpy(), blended)
    posed, box = cpu.skin_nodes(skin_arrays.nodes, blended)
    cell = skin_arrays.lattice.cell
    origin = (np.floor(box[0] / cell) * cell).astype(np.float32)
    dims = (np.ceil((box[1] - origin) / cell) + 1).astype(np.int64)
    canonical, cell_codes, affine_maps = cpu.bake_warp_grid(posed, skin_arrays, PosedGrid(origin, dims))
    return WarpGrid(origin, dims, canonical, cell_codes, affine_maps)


class _NewtonStep(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, blended: Tensor, start: Tensor, posed: Tensor, frame_offsets: Tensor, skin: SkinGrid
    ) -> Tensor:
        batch_index = segment_ids_from_counts(frame_offsets.diff())
        refined, inverse_jacobian = torch.empty_like(start), start.new_empty(len(start), 9)
        newton_cpu.newton_step_batch(
            posed.numpy(),
            start.numpy(),
            batch_index.numpy(),
            skin.lattice_arrays(),
            blended.detach().numpy(),
            refined.numpy(),
            inverse_jacobian.numpy(),
        )
        ctx.save_for_backward(blended, start, inverse_jacobian, frame_offsets)
        ctx.skin = skin
        return refined

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        blended, *step, frame_offsets = (tensor.detach() for tensor in ctx.saved_tensors)
        grad_blended = torch.zeros_like(blended)
        arrays = (tensor.numpy() for tensor in (*step, gradient.contiguous(), frame_offsets))
        newton_cpu.add_pose_gradient(*arrays, ctx.skin.lattice_arrays(), grad_blended.numpy())
        return grad_blended, None, None, None, None


def newton_step(
    blended: Float[Tensor, "m k 12"],
    start_m: Float[Tensor, "s 3"],
    posed_m: Float[Tensor, "s 3"],
    frame_offsets: Int[Tensor, "k1"],
    skin: SkinGrid,
) -> Float[Tensor, "s 3"]:
    """Do one Newton step towards the canonical points that skinning moves to `posed_m`.

    Args:
        blended: `SkinGrid.blend` of the frames of the batch. Differentiable by the implicit function theorem,
            dx = -J^-1 dA x, with J and x of the start, which avoids a second evaluation.
        start_m: canonical points to start from (the lookup in a warp grid). Returned where no step is possible.
        frame_offsets: k + 1 offsets; the samples of frame f are frame_offsets[f] : frame_offsets[f + 1].
    """
    if not runs_on_numba(blended, start_m, posed_m):
        return reference.newton_step(blended, start_m, posed_m, frame_offsets, skin.lattice)
    return _NewtonStep.apply(blended.contiguous(), start_m.contiguous(), posed_m.contiguous(), frame_offsets, skin)
