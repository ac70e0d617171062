"""Inverse skinning: from posed points back to the canonical A-pose.

A `SkinGrid` holds skin weights on the nodes near the canonical body. For one frame, `bake_warp_grid` turns its skinning
matrices into a `WarpGrid` that says for each node of a posed grid where it lies in canonical space; a lookup there,
and at most one Newton step (`newton_step`), replaces the 13-start Broyden search of SNARF and InstantAvatar (Chen et
al.
2021, Jiang et al. 2023). Where limbs come near each other a posed cell has several inverses: it then holds one
affine map for each.

Letters: m skin-grid nodes, j joints, k frames of a batch, s samples.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from pipeline.kernels.blend import SparseWeights, blend
from pipeline.kernels.common.dispatch import runs_on_numba
from pipeline.kernels.common.packing import segment_ids_from_counts
from pipeline.kernels.inverse_skinning import cpu as warp_cpu
from pipeline.kernels.inverse_skinning import newton_cpu, reference
from pipeline.kernels.inverse_skinning.reference import Lattice


@dataclass(frozen=True)
class SkinGrid:
    """Skin weights near the canonical body, continuous in space: trilinear between nodes `cell_m` apart."""

    origin_m: Float[Tensor, "3"]
    cell_m: float
    row_of_node: Int[Tensor, "gx gy gz"]
    nodes_m: Float[Tensor, "m 3"]
    distance_m: Float[Tensor, "m"]
    weights: Float[Tensor, "m j"]

    @property
    def lattice(self) -> Lattice:
        """Where the nodes are; what `pipeline.kernels.inverse_skinning.reference` interpolates on."""
        return self.origin_m, self.cell_m, self.row_of_node

    def to(self, device: torch.device) -> "SkinGrid":
        """The same grid on another device; itself if it is there already."""
        if self.weights.device == device:
            return self
        moved = (tensor.to(device) for tensor in (self.row_of_node, self.nodes_m, self.distance_m, self.weights))
        return SkinGrid(self.origin_m.to(device), self.cell_m, *moved)

    def blend(self, canonical_to_posed: Float[Tensor, "k j 4 4"]) -> Float[Tensor, "m k 12"]:
        """The blended skinning matrix (rows of its upper 3x4 part) at every node: one product for all frames."""
        by_joint = canonical_to_posed[:, :, :3].transpose(0, 1).flatten(1)
        return blend(self.sparse_weights, by_joint).view(-1, len(canonical_to_posed), 12)

    @cached_property
    def sparse_weights(self) -> SparseWeights:
        """The weights without their zeros: a node hangs on two or three joints."""
        return SparseWeights.of(self.weights)

    def crop_to_occupied(self, occupied: UInt8[Tensor, "ox oy oz"], bounds_m: Float[Tensor, "2 3"]) -> "SkinGrid":
        """The same grid without the nodes that no point of an occupied cell is interpolated from.

        occupied: not zero for the cells that are meant; they fill the box `bounds_m`. Along each axis a matrix says
        which nodes are corners of a cell of this grid that meets which layer of occupied cells.
        """
        wanted, device = (occupied != 0).float(), occupied.device
        low_m, high_m = bounds_m.double()
        for axis, (nodes, cells) in enumerate(zip(self.row_of_node.shape, occupied.shape, strict=True)):
            at_m = self.origin_m[axis] + torch.arange(nodes, device=device).double()[:, None] * self.cell_m
            part = torch.arange(cells + 1, device=device).double() / cells
            edges_m = low_m[axis] + part * (high_m[axis] - low_m[axis])
            meets = (edges_m[:-1] <= at_m + self.cell_m) & (edges_m[1:] >= at_m - self.cell_m)
            wanted = torch.tensordot(meets.float(), wanted, dims=([1], [axis])).movedim(0, axis)
        kept = (wanted > 0) & (self.row_of_node >= 0)
        rows = self.row_of_node[kept].long()
        row_of_node = torch.full_like(self.row_of_node, -1)
        row_of_node[kept] = torch.arange(len(rows), device=device).to(row_of_node)
        nodes_m, distance_m, weights = (x.index_select(0, rows) for x in (self.nodes_m, self.distance_m, self.weights))
        return SkinGrid(self.origin_m, self.cell_m, row_of_node, nodes_m, distance_m, weights)

    def interpolate_weights(self, points_m: Float[Tensor, "n 3"]) -> Float[Tensor, "n j"]:
        """Skin weights of canonical points; outside the grid, those of the nearest node that exists."""
        return reference.interpolate(points_m, self.lattice, self.weights.to(points_m))


@dataclass(frozen=True)
class WarpGrid:
    """Inverse skinning of one frame on a posed grid whose cells are as large as the skin grid's.

    canonical_m: position of each node in canonical space, NaN where unknown (x slowest, z fastest).
    codes: a code a cell: -1 no inverse, 0 one smooth inverse (interpolate), 1 + 4 * first + (count - 1) several
    inverses: rows first..first + count - 1 of `affine_maps`, which are affine maps (3x4 by rows) from posed to
    canonical.
    """

    origin_m: Float[np.ndarray, "3"]
    dims: Int[np.ndarray, "3"]
    canonical_m: Float[np.ndarray, "nodes 3"]
    cell_codes: Int[np.ndarray, "cells"]
    affine_maps: Float[np.ndarray, "maps 12"]


def bake_warp_grid(skin: SkinGrid, canonical_to_posed: Float[Tensor, "j 4 4"]) -> WarpGrid:
    """Invert the skinning of one frame; `skin` is on the CPU. Without the GIL: threads may bake different frames."""
    # A dense product: not more than one thread may enter a parallel loop.
    matrices = canonical_to_posed.detach().float().cpu()[:, :3].flatten(1)
    blended = (skin.weights @ matrices)[:, None].numpy()
    nodes, distance, skin_origin, rows = (
        tensor.numpy() for tensor in (skin.nodes_m, skin.distance_m, skin.origin_m, skin.row_of_node)
    )
    posed, box = warp_cpu.skin_nodes(nodes, blended)
    cell = np.float32(skin.cell_m)
    origin = (np.floor(box[0] / cell) * cell).astype(np.float32)
    dims = (np.ceil((box[1] - origin) / cell) + 1).astype(np.int64)
    canonical, cell_codes, affine_maps = warp_cpu.bake_warp_grid(
        nodes, posed, distance, origin, dims, skin_origin, cell, rows, blended
    )
    return WarpGrid(origin, dims, canonical, cell_codes, affine_maps)


class _NewtonStep(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, blended: Tensor, start: Tensor, posed: Tensor, frame_offsets: Tensor, skin: SkinGrid
    ) -> Tensor:
        batch_index = segment_ids_from_counts(frame_offsets.diff())
        refined, inverse_jacobian = torch.empty_like(start), start.new_empty(len(start), 9)
        grid = (skin.origin_m.numpy(), np.float32(skin.cell_m), skin.row_of_node.numpy())
        arrays = (posed.numpy(), start.numpy(), batch_index.numpy())
        newton_cpu.newton_step_batch(
            *arrays, *grid, blended.detach().numpy(), refined.numpy(), inverse_jacobian.numpy()
        )
        ctx.save_for_backward(blended, start, inverse_jacobian, frame_offsets)
        ctx.skin = skin
        return refined

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        blended, *step, frame_offsets = (tensor.detach() for tensor in ctx.saved_tensors)
        skin = ctx.skin
        total = torch.zeros_like(blended)
        grid = (skin.origin_m.numpy(), np.float32(skin.cell_m), skin.row_of_node.numpy())
        arrays = (tensor.numpy() for tensor in (*step, gradient.contiguous(), frame_offsets))
        newton_cpu.add_pose_gradient(*arrays, *grid, total.numpy())
        return total, None, None, None, None


def newton_step(
    blended: Float[Tensor, "m k 12"],
    start_m: Float[Tensor, "s 3"],
    posed_m: Float[Tensor, "s 3"],
    frame_offsets: Int[Tensor, "k1"],
    skin: SkinGrid,
) -> Float[Tensor, "s 3"]:
    """One Newton step towards the canonical points that skinning carries to `posed_m`.

    Args:
        blended: `SkinGrid.blend` of the batch's frames. Differentiable, by the implicit function theorem: dx = -J^-1
        dA x, with J and x of the start, which spares a second evaluation.
        start_m: canonical points to start from (a warp grid's answer). Where no step is possible they are the result.
        slot_start: k + 1 offsets; the samples of frame f are slot_start[f] : slot_start[f + 1].
    """
    if not runs_on_numba(blended, start_m, posed_m):
        return reference.newton_step(blended, start_m, posed_m, frame_offsets, skin.lattice)
    return _NewtonStep.apply(blended.contiguous(), start_m.contiguous(), posed_m.contiguous(), frame_offsets, skin)
