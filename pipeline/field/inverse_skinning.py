"""Inverse skinning of samples along camera rays, by three methods. Samples follow `pipeline.kernels.march.march`.

- baked: lookup in warp grids, which are inverted once per pose, then one Newton step. The default.
- broyden: Broyden's method from thirteen bones for every sample (InstantAvatar, Jiang et al. 2023).
- nearest: inverse skinning matrix of the nearest posed vertex (Anim-NeRF, Chen et al. 2021).

Letters: k frames of the motion, b frames of a batch, j joints, m skin grid nodes, s samples, n rays, p points.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from pipeline.body.body import Body
from pipeline.field.occupancy import BinaryOccupancy, cell_centres
from pipeline.field.skin_grid import bake_warp_grids
from pipeline.geometry.skinning import linear_blend_skinning
from pipeline.kernels import broyden
from pipeline.kernels.inverse_skinning import SkinGrid, newton_step
from pipeline.kernels.inverse_skinning.reference import skin_points
from pipeline.kernels.march import PackedWarpGrids, Rays, Samples, SamplingVolume, march
from pipeline.kernels.march.reference_stops import march_with_inverse

INITIAL_BONES: tuple[str, ...] = (
    "Hips", "LeftUpLeg", "RightUpLeg", "LeftLeg", "RightLeg", "LeftToeBase", "RightToeBase",
    "Neck", "Head", "LeftArm", "RightArm", "LeftForeArm", "RightForeArm",
)  # fmt: skip
"""The thirteen bones from which InstantAvatar starts its search, by their names in this pipeline."""


@dataclass(frozen=True)
class InverseSkinning:
    """Inverse skinning of the frames of a motion.

    posed_bounds_m: bounding box of each frame in its posed space, low and high corner.
    sample_rays(rays, step_m, occupancy, max_samples): samples in occupied cells.
    to_canonical(skin, canonical_to_posed, frames, canonical_m, posed_m, frame_offsets): canonical positions (s, 3) of
    samples at `posed_m` for the poses (b, j, 4, 4) of the rows `frames` (b); `canonical_m` are the positions from
    `sample_rays`. Samples of frame i are frame_offsets[i] : frame_offsets[i + 1]. Differentiable in the poses.
    warps: warp grids of the method "baked", None for the others.
    """

    posed_bounds_m: Float[Tensor, "k 2 3"]
    sample_rays: Callable[[Rays, float, BinaryOccupancy, int], Samples]
    to_canonical: Callable[[SkinGrid, Tensor, Tensor, Tensor, Tensor, Tensor], Tensor]
    warps: PackedWarpGrids | None = None


def build_inverse_skinning(
    method: str, body: Body, skin: SkinGrid, canonical_to_posed: Float[Tensor, "k j 4 4"]
) -> InverseSkinning:
    """Prepare a method ("baked", "broyden" or "nearest") for the poses of all frames.

    Raises:
        KeyError: the method is unknown.
    """
    return {"baked": _baked, "broyden": _broyden, "nearest": _nearest}[method](body, skin, canonical_to_posed.detach())


def _newton_to_canonical(
    skin: SkinGrid,
    canonical_to_posed: Tensor,
    frames: Tensor,
    canonical_m: Tensor,
    posed_m: Tensor,
    frame_offsets: Tensor,
) -> Tensor:
    return newton_step(skin.blend(canonical_to_posed), canonical_m, posed_m, frame_offsets, skin)


def _baked(body: Body, skin: SkinGrid, canonical_to_posed: Float[Tensor, "k j 4 4"]) -> InverseSkinning:
    warps = bake_warp_grids(skin, canonical_to_posed)

    def sample_rays(rays: Rays, step_m: float, occupancy: BinaryOccupancy, max_samples: int) -> Samples:
        return march(rays, SamplingVolume(warps, occupancy.occupied, occupancy.bounds_m), step_m, max_samples)

    low = warps.origin_m
    high = low + warps.cell_m * (warps.dims - 1).float()
    return InverseSkinning(torch.stack([low, high], dim=1), sample_rays, _newton_to_canonical, warps)


def _broyden(body: Body, skin: SkinGrid, canonical_to_posed: Float[Tensor, "k j 4 4"]) -> InverseSkinning:
    bones = [body.joint(name) for name in INITIAL_BONES]
    posed_bounds_m = _bounds_m(_posed_vertices_m(body, canonical_to_posed), skin)

    def sample_rays(rays: Rays, step_m: float, occupancy: BinaryOccupancy, max_samples: int) -> Samples:
        rows, slot = torch.unique(rays.frame_index, return_inverse=True)
        matrices = canonical_to_posed[rows]
        blended = skin.blend(matrices)
        kd_trees, max_distance_m = _posed_cells(occupancy, blended, skin)

        def find_canonical(posed_m: Float[Tensor, "p 3"], slot: Int[Tensor, "p"]) -> tuple[Tensor, Tensor]:
            near = _nearest_index(kd_trees, posed_m, slot, max_distance_m) >= 0
            points = posed_m.new_zeros(len(posed_m), broyden.CANDIDATES, 3)
            exists = torch.zeros(points.shape[:2], dtype=torch.bool, device=points.device)
            points[near], exists[near] = broyden.find_roots(
                posed_m[near], slot[near], matrices[:, bones], blended, skin
            )
            return points, exists

        grid = (occupancy.occupied, occupancy.bounds_m)
        return Samples(
            *march_with_inverse(
                find_canonical, rays._replace(frame_index=slot), step_m, posed_bounds_m[rows], *grid, max_samples
            )
        )

    return InverseSkinning(posed_bounds_m, sample_rays, _newton_to_canonical)


def _posed_cells(
    occupancy: BinaryOccupancy, blended: Float[Tensor, "m b 12"], skin: SkinGrid
) -> tuple[dict[int, cKDTree], float]:
    """Return a tree of the posed centres of the occupied cells for each frame, and the half-size of a posed cell, m.

    The search skips ray stops that are not near any of them, as a grid in posed space does in InstantAvatar.
    """
    bounds_m, occupied = occupancy.bounds_m.cpu().numpy(), occupancy.occupied.cpu().numpy()
    centres_m = torch.from_numpy(cell_centres(bounds_m, len(occupied))[occupied.reshape(-1) > 0]).to(blended.device)
    kd_trees = {
        slot: cKDTree(skin_points(centres_m, matrix, skin.lattice).cpu().numpy())
        for slot, matrix in enumerate(blended.unbind(1))
    }
    # A whole diagonal instead of half of it, because skinning may stretch a cell.
    return kd_trees, float(np.linalg.norm((bounds_m[1] - bounds_m[0]) / occupied.shape))


def _nearest(body: Body, skin: SkinGrid, canonical_to_posed: Float[Tensor, "k j 4 4"]) -> InverseSkinning:
    weights = torch.from_numpy(body.skin_weights).to(canonical_to_posed.device)
    vertices_m = _posed_vertices_m(body, canonical_to_posed)
    posed_bounds_m = _bounds_m(vertices_m, skin)
    kd_trees = {row: cKDTree(vertices.cpu().numpy()) for row, vertices in enumerate(vertices_m)}

    def invert_skinning(
        matrices: Float[Tensor, "j 4 4"], vertex: Int[Tensor, "p"], posed_m: Float[Tensor, "p 3"]
    ) -> Tensor:
        matrix = (weights[vertex] @ matrices[:, :3].reshape(-1, 12)).view(-1, 3, 4)
        return torch.linalg.solve(matrix[:, :, :3], posed_m - matrix[:, :, 3])

    def find_canonical(posed_m: Float[Tensor, "p 3"], frame: Int[Tensor, "p"]) -> tuple[Tensor, Tensor]:
        vertex = _nearest_index(kd_trees, posed_m, frame, float(skin.distance_m.max()))
        points = torch.zeros_like(posed_m)
        for row in frame.unique().tolist():
            in_frame = (frame == row) & (vertex >= 0)
            points[in_frame] = invert_skinning(canonical_to_posed[row], vertex[in_frame], posed_m[in_frame])
        return points[:, None], (vertex >= 0)[:, None]

    def sample_rays(rays: Rays, step_m: float, occupancy: BinaryOccupancy, max_samples: int) -> Samples:
        grid = (occupancy.occupied, occupancy.bounds_m)
        return Samples(*march_with_inverse(find_canonical, rays, step_m, posed_bounds_m, *grid, max_samples))

    def to_canonical(
        skin: SkinGrid, matrices: Tensor, frames: Tensor, canonical_m: Tensor, posed_m: Tensor, frame_offsets: Tensor
    ) -> Tensor:
        sizes = frame_offsets.diff()
        vertex = _nearest_index(kd_trees, posed_m, torch.repeat_interleave(frames, sizes), np.inf)
        of_frames = zip(matrices, vertex.split(sizes.tolist()), posed_m.split(sizes.tolist()), strict=True)
        return torch.cat([invert_skinning(*of_frame) for of_frame in of_frames])

    return InverseSkinning(posed_bounds_m, sample_rays, to_canonical)


def _posed_vertices_m(body: Body, canonical_to_posed: Float[Tensor, "k j 4 4"]) -> Float[Tensor, "k v 3"]:
    device = canonical_to_posed.device
    vertices, weights = torch.from_numpy(body.vertices).to(device), torch.from_numpy(body.skin_weights).to(device)
    return linear_blend_skinning(vertices, weights, canonical_to_posed)


def _bounds_m(vertices_m: Float[Tensor, "k v 3"], skin: SkinGrid) -> Float[Tensor, "k 2 3"]:
    """Return the boxes of the posed bodies, widened by the margin of the skin grid."""
    max_distance_m = float(skin.distance_m.max())
    return torch.stack([vertices_m.amin(1) - max_distance_m, vertices_m.amax(1) + max_distance_m], dim=1)


def _nearest_index(
    kd_trees: dict[int, cKDTree], points_m: Float[Tensor, "p 3"], frame: Int[Tensor, "p"], max_distance_m: float
) -> Int[Tensor, "p"]:
    """Return the nearest tree point of each point's frame; -1 if none is within `max_distance_m`."""
    nearest = torch.full((len(points_m),), -1, device=points_m.device)
    for row in frame.unique().tolist():
        in_frame = torch.nonzero(frame == row)[:, 0]
        query_m = points_m[in_frame].detach().cpu().numpy()
        _, index = kd_trees[row].query(query_m, distance_upper_bound=max_distance_m, workers=torch.get_num_threads())
        nearest[in_frame] = torch.from_numpy(np.where(index < kd_trees[row].n, index, -1)).to(nearest)
    return nearest
