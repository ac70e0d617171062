"""Full images of the canonical field in a pose."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.body.body import Body
from pipeline.core.device import CPU
from pipeline.field.field import RadianceField
from pipeline.field.inverse_skinning import InverseSkinning, Rays, build_inverse_skinning
from pipeline.field.occupancy import BinaryOccupancy
from pipeline.field.skin_grid import build_skin_grid, skin_margin_m, world_to_posed
from pipeline.field.volume_rendering import PoseBatch, render_rays, uses_early_termination
from pipeline.geometry.camera import Camera, pixel_rays, project
from pipeline.kernels.common.grid_corners import corner_offsets
from pipeline.kernels.common.packing import segment_ids_from_counts
from pipeline.kernels.common.thread_pool import ThreadPool
from pipeline.kernels.composite import composite
from pipeline.kernels.hashgrid import FeatureGradients
from pipeline.kernels.inverse_skinning import SkinGrid

RAY_CHUNK_SIZE = 1 << 13
STEPS_PER_BODY_HEIGHT, MAX_SAMPLES_PER_RAY = 125, 256
SAMPLE_CHUNK_SIZE = 8
"""Of each ray, near to far, before it is asked whether anything behind them can still be seen."""
MAX_OPTICAL_DEPTH = 9.0
"""Optical depth behind which a ray ends: an eight-thousandth of the light is left, a thirtieth of a grey level."""


@dataclass(frozen=True)
class PoseWarps:
    """A body in some poses and the way back from each: what their renders share, whatever the camera.

    to_posed: rigid maps from the world to the posed spaces. canonical_to_posed: the skinning matrices there.
    """

    skin: SkinGrid
    to_posed: Float[Tensor, "k 4 4"]
    canonical_to_posed: Float[Tensor, "k j 4 4"]
    inverse: InverseSkinning
    step_m: float


def build_pose_warps(
    field: RadianceField, body: Body, skin: SkinGrid, canonical_to_world: Float[Tensor, "k j 4 4"]
) -> PoseWarps:
    """Invert the skinning of all poses, at least one, in the field's way, on the field's device."""
    device = field.bounds_m.device
    skin, canonical_to_world = skin.to(device), canonical_to_world.float().to(device)
    to_posed = world_to_posed(canonical_to_world)
    canonical_to_posed = to_posed[:, None] @ canonical_to_world
    inverse = build_inverse_skinning(field.inverse_skinning, body, skin, canonical_to_posed)
    return PoseWarps(skin, to_posed, canonical_to_posed, inverse, body.height_m() / STEPS_PER_BODY_HEIGHT)


def render_field(
    field: RadianceField,
    occupancy: BinaryOccupancy,
    body: Body,
    canonical_to_world: Float[Tensor, "j 4 4"],
    camera: Camera,
    skin: SkinGrid | None = None,
) -> Float[Tensor, "h w 4"]:
    """Premultiplied colour and alpha of every pixel, without gradient, on the CPU; computed where the field is.

    skin: the body's skin grid, from `build_skin_grid`; give it when many images are rendered, it takes a second to
    build.
    """
    skin = skin or build_skin_grid(body, skin_margin_m(body, occupancy.bounds_m.cpu().numpy()))
    return render_pose(field, occupancy, build_pose_warps(field, body, skin, canonical_to_world[None]), 0, camera)


def render_pose(
    field: RadianceField, occupancy: BinaryOccupancy, poses: PoseWarps, row: int, camera: Camera
) -> Float[Tensor, "h w 4"]:
    """`render_field` of one of some poses whose skinning is inverted already."""
    occupancy, to_posed = occupancy.to(field.bounds_m.device), poses.to_posed[row]
    image = torch.zeros(camera.height, camera.width, 4)

    def render_chunk(rows: Tensor, columns: Tensor) -> None:
        pixels_px = torch.stack([columns, rows], dim=-1) + 0.5
        rays = _transform_rays(*pixel_rays(camera, pixels_px), to_posed)
        with torch.no_grad():
            chunk_rgba = _render_chunk_rays(field, occupancy, poses, row, rays)
        image[rows.cpu(), columns.cpu()] = chunk_rgba.cpu()

    parts = _pixels_in_box(poses.inverse.posed_bounds_m[row], to_posed, camera)
    _thread_pool(torch.get_num_threads() if to_posed.device == CPU else 1).map(render_chunk, *zip(*parts, strict=True))
    return image


@cache
def _thread_pool(count: int) -> ThreadPool:
    return ThreadPool(count)


def _transform_rays(origins: Tensor, directions: Tensor, matrix: Float[Tensor, "4 4"]) -> tuple[Tensor, Tensor]:
    rotation = matrix[:3, :3]
    return origins @ rotation.T + matrix[:3, 3], directions @ rotation.T


def _pixels_in_box(
    box_m: Float[Tensor, "2 3"], to_posed: Float[Tensor, "4 4"], camera: Camera
) -> Iterator[tuple[Tensor, Tensor]]:
    """Rows and columns of the pixels that may see the posed box, in parts."""
    corners = (box_m[0] + corner_offsets(box_m.device) * (box_m[1] - box_m[0]) - to_posed[:3, 3]) @ to_posed[:3, :3]
    corners_px, depth_m = project(corners, camera)
    x0, y0, x1, y1 = 0, 0, camera.width, camera.height
    if bool((depth_m > 0.05).all()):
        x0, y0 = (max(0, int(value)) for value in corners_px.amin(0).floor())
        x1, y1 = (int(value) + 1 for value in corners_px.amax(0).ceil())
        x1, y1 = min(x1, camera.width), min(y1, camera.height)
    if x1 <= x0 or y1 <= y0:
        return
    pixels = torch.cartesian_prod(torch.arange(y0, y1), torch.arange(x0, x1)).to(box_m.device)
    for part in pixels.split(RAY_CHUNK_SIZE):
        yield part[:, 0], part[:, 1]


def _render_chunk_rays(
    field: RadianceField,
    occupancy: BinaryOccupancy,
    poses: PoseWarps,
    row: int,
    rays: tuple[Tensor, Tensor],
) -> Float[Tensor, "n 4"]:
    origins, directions = rays
    count, device, step_m = len(origins), origins.device, poses.step_m
    frame, jitter = torch.full((count,), row, device=device), torch.full((count,), 0.5, device=device)
    if uses_early_termination(field, poses.inverse):
        pose_batch = PoseBatch(poses.skin, frame[:1], poses.canonical_to_posed[row : row + 1])
        inputs = (occupancy, Rays(origins, directions, frame, jitter), pose_batch, origins[:0])
        rendered = render_rays(field, poses.inverse, *inputs, step_m, MAX_SAMPLES_PER_RAY, FeatureGradients())
        return torch.cat([rendered.image, rendered.alpha[:, None]], dim=-1)
    samples = poses.inverse.sample_rays(
        Rays(origins, directions, frame, jitter), step_m, occupancy, MAX_SAMPLES_PER_RAY
    )
    ray = segment_ids_from_counts(samples.ray_offsets.diff())
    pending, next_rank = torch.arange(len(ray), device=device), 0
    rank = pending - samples.ray_offsets[ray]
    colour, density = torch.zeros(len(ray), 3, device=device), torch.zeros(len(ray), device=device)
    optical_depth = torch.zeros(count, device=device)
    while len(pending):
        next_rank += SAMPLE_CHUNK_SIZE
        is_next = rank[pending] < next_rank
        rows, pending = pending[is_next], pending[~is_next]
        posed = origins[ray[rows]] + samples.distance_m[rows, None] * directions[ray[rows]]
        slot, frame_offsets = torch.tensor([row], device=device), torch.tensor([0, len(rows)], device=device)
        matrices, found = poses.canonical_to_posed[row : row + 1], samples.canonical_m[rows]
        points = poses.inverse.to_canonical(poses.skin, matrices, slot, found, posed, frame_offsets)
        colour[rows], density[rows] = field(points)
        optical_depth.index_add_(0, ray[rows], density[rows] * step_m)
        pending = pending[optical_depth[ray[pending]] < MAX_OPTICAL_DEPTH]
    image, alpha, _ = composite(density, colour, torch.full_like(density, step_m), samples.ray_offsets)
    return torch.cat([image, alpha[:, None]], dim=-1)


def over_white(image: Float[Tensor, "h w 4"]) -> Float[Tensor, "h w 3"]:
    """Premultiplied colour and alpha over a white background."""
    return image[..., :3] + (1 - image[..., 3:])
