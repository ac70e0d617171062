"""Visual hull of an articulated body in canonical space (Laurentini 1994), without training.

Every node of a grid is posed in every frame by its skin weights and projected into the mask. The fraction of the masks
that contain it gives its density. A dense grid of one level holds the result, so that a hull is a `RadianceField`,
which all later stages accept.

Letters: k frames, j joints, n points.
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, UInt8
from scipy.spatial import cKDTree
from torch import Tensor

from pipeline.body.body import Body
from pipeline.field.field import INITIAL_DENSITY_PER_M, MAX_ABS_LOG_DENSITY, RadianceField
from pipeline.geometry.camera import Camera, project_to_pixels
from pipeline.kernels.hashgrid import GridLayout
from pipeline.kernels.inverse_skinning import SkinGrid
from pipeline.kernels.inverse_skinning.reference import interpolate

CHANNELS = 4
"""Three colours and the density."""
SURFACE_DENSITY_PER_M = 32.0
"""Density where just enough masks contain a point: in the middle of the isovalues that the mesh stage tries."""
LOG_DENSITY_SLOPE = 40.0
"""Slope of the log density over the mask fraction: the density rises twentyfold within 0.07."""


def dense_layout(bounds_m: Float[np.ndarray, "2 3"], cell_m: float, log2_hashmap_size: int) -> GridLayout:
    """Return a layout of one level with a row per node: cells of `cell_m`, or larger so that 2**log2_hashmap_size rows
    suffice.
    """
    sides_m = np.asarray(bounds_m[1] - bounds_m[0], dtype=np.float64)
    while np.prod(np.ceil(sides_m / cell_m) + 1) > 2**log2_hashmap_size:
        cell_m *= 1.02
    x, y, z = (int(cells) for cells in np.ceil(sides_m / cell_m))
    return GridLayout(((x, y, z),), CHANNELS, log2_hashmap_size)


def node_positions_m(bounds_m: Float[np.ndarray, "2 3"], layout: GridLayout) -> Float[np.ndarray, "nodes 3"]:
    """Return the positions (m) of the nodes of a dense level, in the order of its rows (z slowest)."""
    axes = [np.linspace(bounds_m[0, axis], bounds_m[1, axis], layout.cells_per_axis[0][axis] + 1) for axis in range(3)]
    z, y, x = np.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
    return np.stack([x, y, z], axis=-1).reshape(-1, 3).astype(np.float32)


def carve_visual_hull(
    body: Body,
    skin: SkinGrid,
    canonical_to_world: Float[Tensor, "k j 4 4"],
    camera: Camera,
    masked_images: Sequence[tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]],
    bounds_m: Float[np.ndarray, "2 3"],
    layout: GridLayout,
    min_mask_fraction: float,
) -> RadianceField:
    """Compute a field from images and masks, one pair per frame; its density is 0 outside the skin grid.

    layout: from `dense_layout`. min_mask_fraction: fraction of the frames whose mask must contain a point, in (0, 1].
    """
    nodes_m = node_positions_m(bounds_m, layout)
    inside = np.flatnonzero(inside_skin_grid(nodes_m, skin))
    mask_fraction, colours = _accumulate_votes(nodes_m[inside], body, skin, canonical_to_world, camera, masked_images)
    raw = torch.zeros(len(nodes_m), CHANNELS)
    raw[:, 3] = -MAX_ABS_LOG_DENSITY
    raw[inside, :3] = torch.logit(torch.from_numpy(colours), eps=1 / 512)
    density = np.log(SURFACE_DENSITY_PER_M / INITIAL_DENSITY_PER_M) + LOG_DENSITY_SLOPE * (
        mask_fraction - min_mask_fraction
    )
    raw[inside, 3] = torch.from_numpy(density).clamp(-MAX_ABS_LOG_DENSITY, MAX_ABS_LOG_DENSITY)
    return dense_grid_field(bounds_m, layout, raw)


def dense_grid_field(
    bounds_m: Float[np.ndarray, "2 3"], layout: GridLayout, raw: Float[Tensor, "nodes 4"]
) -> RadianceField:
    """Return a field whose output before the activations is that of a dense grid, by x = relu(x) - relu(-x)."""
    field = RadianceField(bounds_m, layout, hidden_width=2 * CHANNELS)
    with torch.no_grad():
        field.table.copy_(raw)
        field.hidden.copy_(torch.cat([torch.eye(CHANNELS), -torch.eye(CHANNELS)], dim=1))
        field.output.copy_(field.hidden.T)
        field.bias.zero_()
    return field


def inside_skin_grid(points_m: Float[np.ndarray, "n 3"], skin: SkinGrid) -> np.ndarray:
    """Return (n,) bool: whether the skin grid has a node at the low corner of each point's cell."""
    origin_m, row_of_node = skin.origin_m.numpy(), skin.row_of_node.numpy()
    index = np.floor((points_m - origin_m) / skin.cell_m).astype(np.int64)
    inside = ((index >= 0) & (index < row_of_node.shape)).all(1)
    inside_grid = np.zeros(len(points_m), dtype=bool)
    inside_grid[inside] = row_of_node[tuple(index[inside].T)] >= 0
    return inside_grid


def _accumulate_votes(
    points_m: Float[np.ndarray, "n 3"],
    body: Body,
    skin: SkinGrid,
    canonical_to_world: Float[Tensor, "k j 4 4"],
    camera: Camera,
    masked_images: Sequence[tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]],
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n 3"]]:
    """Return the fraction of the frames whose mask contains each point, and its mean colour, in [0, 1].

    The weight of a frame's colour is the squared cosine between the viewing direction and the body normal nearest to
    the point, and 0 from behind. Occlusion by other limbs is ignored. Frames in which a point is outside the image do
    not count.
    """
    points = torch.from_numpy(points_m)
    weights = interpolate(points, skin.lattice, skin.weights)
    nearest = cKDTree(body.vertices).query(points_m, workers=torch.get_num_threads())[1]
    normals = torch.from_numpy(body.mesh().vertex_normals()[nearest]).float()
    mask_sum, in_image_count, weight_sum = (
        np.zeros(len(points_m)),
        np.zeros(len(points_m)),
        np.full(len(points_m), 1e-6),
    )
    colours = np.full((len(points_m), 3), 0.5e-6)
    camera_centre_m = torch.from_numpy(camera.centre_m()).float()
    for matrices, (image, mask) in zip(canonical_to_world, masked_images, strict=True):
        matrix = (weights @ matrices[:, :3].reshape(-1, 12)).view(-1, 3, 4)
        posed = (matrix[:, :, :3] @ points[:, :, None])[:, :, 0] + matrix[:, :, 3]
        pixel_row, pixel_column, inside = project_to_pixels(posed, camera)
        pixel_column, pixel_row = pixel_column[inside], pixel_row[inside]
        mask_value = mask[pixel_row, pixel_column] / 255.0
        facing = (matrix[:, :, :3] @ normals[:, :, None])[:, :, 0] * torch.nn.functional.normalize(
            camera_centre_m - posed, dim=1
        )
        weight = mask_value * facing.sum(1).clamp(min=0).square().numpy()[inside]
        in_image_count[inside] += 1
        mask_sum[inside] += mask_value
        weight_sum[inside] += weight
        colours[inside] += weight[:, None] * image[pixel_row, pixel_column] / 255.0
    mask_fraction = mask_sum / np.maximum(in_image_count, 1)
    return mask_fraction.astype(np.float32), (colours / weight_sum[:, None]).astype(np.float32)
