"""Skin weights around the canonical body, and the warp grids of a motion.

The posed space of a frame is the frame of its root joint: the skinning matrix of the root is the identity there. Global
orientation and translation are factored out, so that the bounding box of a frame is as tight as the body.

Letters: n frames, j joints.
"""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
from jaxtyping import Float
from scipy.sparse import csr_array
from scipy.spatial import cKDTree
from torch import Tensor

from pipeline.body.body import Body
from pipeline.core.device import CPU
from pipeline.geometry.surface import signed_distance_m
from pipeline.kernels.inverse_skinning import SkinGrid, WarpGrid, bake_warp_grid
from pipeline.kernels.march import PackedWarpGrids

CELL_M = 0.03
NEIGHBOUR_COUNT = 24
"""Nearest vertices whose skin weights a node averages."""


def build_skin_grid(body: Body, margin_m: float, cell_m: float = CELL_M) -> SkinGrid:
    """Compute skin weights on all grid nodes within `margin_m` (plus two cells) outside the canonical surface, and
    inside.

    InstantAvatar takes the weights of the nearest vertex, which are discontinuous between two limbs. Here they are a
    Gaussian average over the nearest vertices, whose width grows with the distance, so that skinning is continuous.
    """
    max_distance_m = margin_m + 2.5 * cell_m
    origin = (np.floor((body.vertices.min(0) - max_distance_m) / cell_m) * cell_m).astype(np.float32)
    size = np.ceil((body.vertices.max(0) + max_distance_m - origin) / cell_m).astype(np.int64) + 1
    index = np.stack(np.meshgrid(*(np.arange(n) for n in size), indexing="ij"), axis=-1).reshape(-1, 3)
    nodes = (origin + index * np.float32(cell_m)).astype(np.float32)
    tree = cKDTree(body.vertices)
    near = np.isfinite(
        tree.query(nodes, distance_upper_bound=max_distance_m + 0.02, workers=torch.get_num_threads())[0]
    )
    distance = np.full(len(nodes), np.inf, dtype=np.float32)
    distance[near] = signed_distance_m(nodes[near], body.mesh())
    kept = distance < max_distance_m
    row_of_node = np.where(kept, np.cumsum(kept) - 1, -1).astype(np.int32).reshape(tuple(size))
    weights = smooth_skin_weights(nodes[kept], body, cell_m)
    arrays = (origin, row_of_node, nodes[kept], distance[kept], weights)
    origin_m, rows, nodes_m, distance_m, weights_of = (torch.from_numpy(array) for array in arrays)
    return SkinGrid(origin_m, cell_m, rows, nodes_m, distance_m, weights_of)


def skin_margin_m(body: Body, bounds_m: Float[np.ndarray, "2 3"]) -> float:
    """Return the largest distance, m, by which the bounds of a field exceed those of the body: the margin of its skin
    grid.
    """
    return float(max((body.vertices.min(0) - bounds_m[0]).max(), (bounds_m[1] - body.vertices.max(0)).max()))


def smooth_skin_weights(
    points_m: Float[np.ndarray, "n 3"], body: Body, cell_m: float = CELL_M
) -> Float[np.ndarray, "n j"]:
    """Return skin weights of canonical points: a Gaussian average over the nearest vertices of the body."""
    distance, neighbour = cKDTree(body.vertices).query(points_m, k=NEIGHBOUR_COUNT, workers=torch.get_num_threads())
    sigma = 0.5 * cell_m + 0.35 * distance[:, :1]
    kernel = np.exp(-(distance**2 - distance[:, :1] ** 2) / (2 * sigma**2))
    kernel = (kernel / kernel.sum(1, keepdims=True)).astype(np.float32)
    row_start = np.arange(len(points_m) + 1) * NEIGHBOUR_COUNT
    shape = len(points_m), len(body.vertices)
    weights: np.ndarray = csr_array((kernel.ravel(), neighbour.ravel(), row_start), shape=shape) @ body.skin_weights
    return weights


def world_to_posed(canonical_to_world: Float[Tensor, "n j 4 4"]) -> Float[Tensor, "n 4 4"]:
    """Return the rigid transform from world to posed space of each frame: the inverse of the root's skinning matrix."""
    rotation, translation = canonical_to_world[:, 0, :3, :3], canonical_to_world[:, 0, :3, 3]
    inverse = torch.zeros_like(canonical_to_world[:, 0])
    inverse[:, :3, :3] = rotation.transpose(1, 2)
    inverse[:, :3, 3] = -(rotation.transpose(1, 2) @ translation[:, :, None])[:, :, 0]
    inverse[:, 3, 3] = 1
    return inverse


def bake_warp_grids(skin: SkinGrid, canonical_to_posed: Float[Tensor, "n j 4 4"]) -> PackedWarpGrids:
    """Bake the warp grids of all frames on the CPU, one frame per thread; return them on the device of the matrices."""
    skin, matrices = skin.to(CPU), canonical_to_posed.cpu()

    def bake_row(row: int) -> WarpGrid:
        return bake_warp_grid(skin, matrices[row])

    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        packed = PackedWarpGrids.from_grids(pool.map(bake_row, range(len(matrices))), skin.cell_m)
    return packed.to(canonical_to_posed.device)
