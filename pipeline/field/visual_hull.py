"""The cheap end: a visual hull in canonical space (Laurentini 1994, with articulated motion), and nothing learnt.

Every node of a grid is carried into every frame by its skin weights and votes with the mask that it falls on. A dense
grid of one level holds the result, so that a hull is a `Field` like any other, which all later stages take.
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, UInt8
from scipy.spatial import cKDTree
from torch import Tensor

from pipeline.body.body import Body
from pipeline.field.field import LIMIT, START_DENSITY_PER_M, Field
from pipeline.geometry.camera import Camera, project
from pipeline.kernels.hashgrid import GridLayout
from pipeline.kernels.inverse_skinning import SkinGrid
from pipeline.kernels.inverse_skinning.reference import interpolate

CHANNELS = 4
SURFACE_DENSITY_PER_M = 32.0
"""Density where just enough masks hold a point: in the middle of the levels that the mesh stage tries."""
STEEPNESS = 40.0
"""Of the log density over votes: from a fifth of the surface's density to four times it within 0.07 votes."""


def dense_layout(bounds_m: Float[np.ndarray, "2 3"], cell_m: float, log2_rows: int) -> GridLayout:
    """One level with a row for each node: cells of `cell_m`, or larger until 2**log2_rows rows are enough."""
    sides_m = np.asarray(bounds_m[1] - bounds_m[0], dtype=np.float64)
    while np.prod(np.ceil(sides_m / cell_m) + 1) > 2**log2_rows:
        cell_m *= 1.02
    x, y, z = (int(cells) for cells in np.ceil(sides_m / cell_m))
    return GridLayout(((x, y, z),), CHANNELS, log2_rows)


def node_positions_m(bounds_m: Float[np.ndarray, "2 3"], layout: GridLayout) -> Float[np.ndarray, "nodes 3"]:
    """Positions of the nodes of a dense level in the order of its rows (z slowest)."""
    axes = [np.linspace(bounds_m[0, axis], bounds_m[1, axis], layout.cells_per_axis[0][axis] + 1) for axis in range(3)]
    z, y, x = np.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
    return np.stack([x, y, z], axis=-1).reshape(-1, 3).astype(np.float32)


def carve(
    body: Body,
    skin: SkinGrid,
    canonical_to_world: Float[Tensor, "k j 4 4"],
    camera: Camera,
    pictures: Sequence[tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]],
    bounds_m: Float[np.ndarray, "2 3"],
    layout: GridLayout,
    least_votes: float,
) -> Field:
    """A field from images and masks, one pair a frame.

    layout: from `dense_layout`. least_votes: the part of the frames whose masks must hold a point, in (0, 1].
    Beyond the skin grid there is nothing.
    """
    nodes_m = node_positions_m(bounds_m, layout)
    kept = np.flatnonzero(skin_reaches(nodes_m, skin))
    votes, colours = _look(nodes_m[kept], body, skin, canonical_to_world, camera, pictures)
    raw = torch.zeros(len(nodes_m), CHANNELS)
    raw[:, 3] = -LIMIT
    raw[kept, :3] = torch.logit(torch.from_numpy(colours), eps=1 / 512)
    density = np.log(SURFACE_DENSITY_PER_M / START_DENSITY_PER_M) + STEEPNESS * (votes - least_votes)
    raw[kept, 3] = torch.from_numpy(density).clamp(-LIMIT, LIMIT)
    return raw_field(bounds_m, layout, raw)


def raw_field(bounds_m: Float[np.ndarray, "2 3"], layout: GridLayout, raw: Float[Tensor, "nodes 4"]) -> Field:
    """The field that says what a dense grid holds: x = relu(x) - relu(-x) takes the hidden layer out of the way."""
    field = Field(bounds_m, layout, hidden_width=2 * CHANNELS)
    with torch.no_grad():
        field.table.copy_(raw)
        field.hidden.copy_(torch.cat([torch.eye(CHANNELS), -torch.eye(CHANNELS)], dim=1))
        field.output.copy_(field.hidden.T)
        field.bias.zero_()
    return field


def skin_reaches(points_m: Float[np.ndarray, "n 3"], skin: SkinGrid) -> np.ndarray:
    """True for each point with a node of the skin grid at the low corner of its cell."""
    origin_m, row_of_node = skin.origin_m.numpy(), skin.row_of_node.numpy()
    index = np.floor((points_m - origin_m) / skin.cell_m).astype(np.int64)
    inside = ((index >= 0) & (index < row_of_node.shape)).all(1)
    reached = np.zeros(len(points_m), dtype=bool)
    reached[inside] = row_of_node[tuple(index[inside].T)] >= 0
    return reached


def _look(
    points_m: Float[np.ndarray, "n 3"],
    body: Body,
    skin: SkinGrid,
    canonical_to_world: Float[Tensor, "k j 4 4"],
    camera: Camera,
    pictures: Sequence[tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]],
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n 3"]]:
    """Part of the frames whose mask holds each point, and the mean colour that it was seen in.

    A frame's colour counts by the squared cosine between the view and the body's normal nearest to the point, and not
    at all from behind: what other limbs hide is taken for seen. Frames in which a point leaves the image do not count;
    a point that is in none has no votes.
    """
    points = torch.from_numpy(points_m)
    weights = interpolate(points, skin.lattice, skin.weights)
    nearest = cKDTree(body.vertices).query(points_m, workers=torch.get_num_threads())[1]
    normals = torch.from_numpy(body.mesh().vertex_normals()[nearest]).float()
    hits, seen, light = np.zeros(len(points_m)), np.zeros(len(points_m)), np.full(len(points_m), 1e-6)
    colours = np.full((len(points_m), 3), 0.5e-6)
    eye = torch.from_numpy(-camera.world_to_camera[:3, :3].T @ camera.world_to_camera[:3, 3]).float()
    for matrices, (image, mask) in zip(canonical_to_world, pictures, strict=True):
        matrix = (weights @ matrices[:, :3].reshape(-1, 12)).view(-1, 3, 4)
        posed = (matrix[:, :, :3] @ points[:, :, None])[:, :, 0] + matrix[:, :, 3]
        pixels, depth_m = project(posed, camera)
        column, line = (pixels[:, axis].floor().long().numpy() for axis in range(2))
        inside = (depth_m.numpy() > 0) & (column >= 0) & (line >= 0) & (column < camera.width) & (line < camera.height)
        column, line = column[inside], line[inside]
        held = mask[line, column] / 255.0
        facing = (matrix[:, :, :3] @ normals[:, :, None])[:, :, 0] * torch.nn.functional.normalize(eye - posed, dim=1)
        weight = held * facing.sum(1).clamp(min=0).square().numpy()[inside]
        seen[inside] += 1
        hits[inside] += held
        light[inside] += weight
        colours[inside] += weight[:, None] * image[line, column] / 255.0
    votes = hits / np.maximum(seen, 1)
    return votes.astype(np.float32), (colours / light[:, None]).astype(np.float32)
