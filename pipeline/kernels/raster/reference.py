"""Plain-torch reference of rasterisation, and silhouette antialiasing.

Notation as in `pipeline.kernels.raster.cpu`. The reductions (max of 1/z, then min of the face index) do not depend on
the order, so that the result is deterministic.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pipeline.kernels.common.packing import segment_ids_from_counts

FRAGMENTS_PER_CHUNK = 1 << 22


class SilhouetteBlends(NamedTuple):
    """Pairs of neighbouring pixels with a silhouette edge between their centres.

    near, far: row-major indices of the pixel inside the silhouette and of the one outside. target: the one of the two
    that changes, by fraction * (value of near - value of far). fraction: differentiable in the vertices.
    """

    target: Int[Tensor, "n"]
    near: Int[Tensor, "n"]
    far: Int[Tensor, "n"]
    fraction: Float[Tensor, "n"]


def signed_areas_px(vertices_px: Float[Tensor, "v 2"], faces: Int[Tensor, "f 3"]) -> Float[Tensor, "f"]:
    """Return twice the signed area of every face (px²): negative for a counter-clockwise face seen from outside."""
    a, b, c = vertices_px[faces].unbind(1)
    return _cross(b - a, c - a)


def _cross(first: Float[Tensor, "*n 2"], second: Float[Tensor, "*n 2"]) -> Float[Tensor, "*n"]:
    return first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0]


def weighted_inverse_depth(
    corners_px: Float[Tensor, "n 3 2"], corners_depth_m: Float[Tensor, "n 3"], points_px: Float[Tensor, "n 2"]
) -> Float[Tensor, "n 3"]:
    """Return q_k = w_k / z_k of each point in its face. Differentiable.

    q / sum(q) are the perspective-correct barycentrics, 1 / sum(q) is the depth.
    """
    a, b, c = corners_px.unbind(1)
    edges = torch.stack(
        [_cross(c - b, points_px - b), _cross(a - c, points_px - c), _cross(b - a, points_px - a)], dim=1
    )
    return edges / _cross(b - a, c - a)[:, None] / corners_depth_m


def _face_boxes(
    vertices_px: Float[Tensor, "v 2"], faces: Int[Tensor, "f 3"], drawn: Bool[Tensor, "f"], size_wh: tuple[int, int]
) -> tuple[Int[Tensor, "f 2"], Int[Tensor, "f 2"]]:
    """Return the first pixel and the extent (columns, rows) of every face; extent 0 if it is not drawn."""
    corners = torch.nan_to_num(vertices_px[faces])
    limit = torch.tensor(size_wh, dtype=corners.dtype, device=corners.device)
    first = torch.minimum((corners.amin(1) - 0.5).clamp_min(0), limit).ceil().long()
    last = torch.minimum((corners.amax(1) - 0.5).clamp_min(-1), limit - 1).floor().long()
    extent = (last - first + 1).clamp_min(0) * drawn[:, None]
    return first, extent


def _fragments(
    vertices_px: Float[Tensor, "v 2"],
    depth_m: Float[Tensor, "v"],
    faces: Int[Tensor, "f 3"],
    first: Tensor,
    extent: Tensor,
    width: int,
) -> tuple[Int[Tensor, "n"], Int[Tensor, "n"], Float[Tensor, "n"]]:
    """Return the fragments of a chunk of faces: face, pixel, and 1/z as float32."""
    counts = extent.prod(1)
    face = segment_ids_from_counts(counts)
    order = torch.arange(len(face), device=faces.device) - (counts.cumsum(0) - counts)[face]
    columns = extent[face, 0]
    x, y = first[face, 0] + order % columns, first[face, 1] + order // columns
    points = torch.stack([x, y], 1).to(torch.float64) + 0.5
    corner = faces[face]
    q = weighted_inverse_depth(vertices_px[corner], depth_m[corner], points)
    inside = (q >= 0).all(1)
    return face[inside], (y * width + x)[inside], q[inside].sum(1).float()


def _chunks(fragments: Int[Tensor, "f"]) -> tuple[Int[Tensor, "_"], ...]:
    """Split the faces into chunks of about FRAGMENTS_PER_CHUNK fragments, to limit memory."""
    _, lengths = torch.unique_consecutive(fragments.cumsum(0) // FRAGMENTS_PER_CHUNK, return_counts=True)
    return torch.split(torch.arange(len(fragments), device=fragments.device), lengths.tolist())


def rasterize_reference(
    vertices_px: Float[Tensor, "v 2"],
    depth_m: Float[Tensor, "v"],
    faces: Int[Tensor, "f 3"],
    height: int,
    width: int,
    near_m: float,
    cull: bool,
) -> tuple[Int[Tensor, "h w"], Float[Tensor, "h w 3"], Float[Tensor, "h w"]]:
    """Do `pipeline.kernels.raster.rasterize` on any device, with any float type."""
    dtype, device = vertices_px.dtype, vertices_px.device
    corners_px, corners_depth, index = vertices_px.double(), depth_m.double(), faces.long()
    area = signed_areas_px(corners_px, index)
    drawn = (corners_depth[index] >= near_m).all(1) & (area < 0 if cull else area.abs() > 0)
    first, extent = _face_boxes(corners_px, index, drawn, (width, height))
    chunks = _chunks(extent.prod(1))
    nearest = torch.zeros(height * width, device=device)
    winner = torch.full((height * width,), len(index), dtype=torch.int64, device=device)
    for chunk in chunks:
        _, pixel, inverse = _fragments(corners_px, corners_depth, index[chunk], first[chunk], extent[chunk], width)
        nearest.scatter_reduce_(0, pixel, inverse, "amax")
    for chunk in chunks:
        face, pixel, inverse = _fragments(corners_px, corners_depth, index[chunk], first[chunk], extent[chunk], width)
        wins = inverse == nearest[pixel]
        winner.scatter_reduce_(0, pixel[wins], chunk[face[wins]], "amin")
    covered = torch.nonzero(winner < len(index)).squeeze(1)
    corner = index[winner[covered]]
    q = weighted_inverse_depth(
        corners_px[corner], corners_depth[corner], pixel_centres_px(covered, width, torch.float64)
    )
    face_id = torch.where(winner < len(index), winner, -1).to(torch.int32)
    barycentric = torch.zeros(height * width, 3, dtype=dtype, device=device)
    depth = torch.full((height * width,), torch.inf, dtype=dtype, device=device)
    barycentric[covered] = (q / q.sum(1, keepdim=True)).to(dtype)
    depth[covered] = (1.0 / q.sum(1)).to(dtype)
    return face_id.view(height, width), barycentric.view(height, width, 3), depth.view(height, width)


def pixel_centres_px(pixel: Int[Tensor, "n"], width: int, dtype: torch.dtype) -> Float[Tensor, "n 2"]:
    """Return the centres (x + 0.5, y + 0.5) of row-major pixel indices."""
    return torch.stack([pixel % width, pixel // width], 1).to(dtype) + 0.5


def silhouette_edges(
    vertices_px: Float[Tensor, "v 2"], faces: Int[Tensor, "f 3"], adjacency: Int[Tensor, "f 3"]
) -> Int[Tensor, "s 3"]:
    """Return the vertices (start, end, apex) of every silhouette edge: no neighbour, or one that faces away."""
    facing = signed_areas_px(vertices_px, faces) < 0
    folded = facing[:, None] & (adjacency >= 0) & ~facing[adjacency.clamp_min(0)]
    face, edge = torch.nonzero(folded | (adjacency < 0), as_tuple=True)
    return torch.stack([faces[face, edge], faces[face, (edge + 1) % 3], faces[face, (edge + 2) % 3]], dim=1)


def _crossings(
    ends_px: Float[Tensor, "s 3 2"], axis: int, lines: int
) -> tuple[Int[Tensor, "n"], Int[Tensor, "n"], Float[Tensor, "n"]]:
    """Return the crossings of edges (start, end, apex) with the lines of pixel centres along `axis`.

    A crossing is the edge, the line, and the fraction of the edge from start to end.
    """
    across = ends_px[:, :2, 1 - axis]
    first = (across.amin(1) - 0.5).clamp(0, lines).ceil().long()
    last = (across.amax(1) - 0.5).clamp(0, lines).ceil().long()
    counts = last - first
    edge = segment_ids_from_counts(counts)
    line = first[edge] + torch.arange(len(edge), device=edge.device) - (counts.cumsum(0) - counts)[edge]
    start, end = across[edge].unbind(1)
    return edge, line, (line + 0.5 - start) / (end - start)


def _outermost(distance: Float[Tensor, "n"], pair: Int[Tensor, "n"], pair_count: int) -> Bool[Tensor, "n"]:
    """Select the crossing farthest from the near pixel, of those between the same two pixels; the first of equals."""
    farthest = torch.full((pair_count,), -1.0, dtype=distance.dtype, device=distance.device)
    farthest.scatter_reduce_(0, pair, distance, "amax")
    order = torch.arange(len(pair), device=pair.device)
    first = torch.full((pair_count,), len(pair), device=pair.device)
    candidate = distance == farthest[pair]
    first.scatter_reduce_(0, pair[candidate], order[candidate], "amin")
    return order == first[pair]


def _blends_along_axis(
    face_id: Int[Tensor, "h w"],
    depth: Float[Tensor, "h w"],
    edges: tuple[Float[Tensor, "s 3 2"], Float[Tensor, "s 2"]],
    axis: int,
) -> SilhouetteBlends:
    """Return the blends by silhouettes between pairs of pixels along `axis` (0: x, 1: y)."""
    ends_px, ends_inverse_depth = edges
    height, width = face_id.shape
    lines, size, step = (height, width, 1) if axis == 0 else (width, height, width)
    edge, line, edge_fraction = _crossings(ends_px, axis, lines)
    start, end, apex = ends_px[edge].unbind(1)
    position = start[:, axis] + edge_fraction * (end[:, axis] - start[:, axis])
    inverse = ends_inverse_depth[edge, 0] + edge_fraction.detach() * (
        ends_inverse_depth[edge, 1] - ends_inverse_depth[edge, 0]
    )
    slope = (end - start)[:, 1 - axis] * (-1.0 if axis == 0 else 1.0)
    # Row pairs and column pairs both meet a border: weights by the squared normal add up to one border.
    weight = (slope**2 / (end - start).square().sum(1)).detach()
    outward = torch.where(_cross(end - start, apex - start) * slope > 0, -1, 1)
    low = (position.detach() - 0.5).clamp(-2, size).floor().long()
    valid = (low >= 0) & (low < size - 1)
    low_pixel = (line * width + low if axis == 0 else low * width + line).where(valid, 0)
    near = low_pixel + (outward < 0) * step
    far = low_pixel + (outward > 0) * step
    behind = depth.reshape(-1)
    valid &= (
        (behind[near] < behind[far])
        & (behind[far] * inverse > 1.0)
        & (face_id.reshape(-1)[near] != face_id.reshape(-1)[far])
    )
    near_position = torch.where(outward < 0, low + 1, low).to(position.dtype) + 0.5
    distance = ((position - near_position) * outward)[valid]
    near, far, low_pixel = near[valid], far[valid], low_pixel[valid]
    keep = _outermost(distance.detach(), low_pixel, height * width)
    fraction, near, far = distance[keep] - 0.5, near[keep], far[keep]
    target = torch.where(fraction.detach() > 0, far, near)
    return SilhouetteBlends(target, near, far, fraction * weight[valid][keep])


def silhouette_blends(
    face_id: Int[Tensor, "h w"],
    depth: Float[Tensor, "h w"],
    vertices_px: Float[Tensor, "v 2"],
    depth_m: Float[Tensor, "v"],
    edges: Int[Tensor, "s 3"],
) -> SilhouetteBlends:
    """Do `pipeline.kernels.raster.silhouette_blends` for silhouette edges that are given as in `silhouette_edges`."""
    edges = edges[(depth_m.detach()[edges] > 0).all(1)]
    ends = (vertices_px[edges], 1.0 / depth_m.detach()[edges[:, :2]])
    along = [_blends_along_axis(face_id, depth, ends, axis) for axis in (0, 1)]
    return SilhouetteBlends(*map(torch.cat, zip(*along, strict=True)))
