"""Images of the canonical field in a pose.

Letters: k poses, j joints, n rays.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.body.body import Body
from pipeline.core.device import CPU
from pipeline.field.field import RadianceField
from pipeline.field.inverse_skinning import InverseSkinning, Rays, build_inverse_skinning
from pipeline.field.occupancy import BinaryOccupancy
from pipeline.field.skin_grid import build_skin_grid, skin_margin_m, world_to_posed
from pipeline.field.volume_rendering import PoseBatch, PosedField, render_rays
from pipeline.geometry.camera import Camera, pixel_rays, project
from pipeline.kernels.common.grid_corners import corner_offsets
from pipeline.kernels.common.packing import segment_ids_from_counts
from pipeline.kernels.common.thread_pool import shared_thread_pool
from pipeline.kernels.composite import composite
from pipeline.kernels.hashgrid import FeatureGradients
from pipeline.kernels.inverse_skinning import SkinGrid

RAY_CHUNK_SIZE = 1 << 13
STEPS_PER_BODY_HEIGHT, MAX_SAMPLES_PER_RAY = 125, 256
SAMPLE_CHUNK_SIZE = 8
"""Samples of each ray, near to far, that are evaluated before rays without transmittance are dropped."""
MAX_OPTICAL_DEPTH = 9.0
"""Optical depth at which a ray ends: the transmittance is 1/8000, a thirtieth of a grey level."""
MIN_DEPTH_M = 0.05
"""If a corner of the box is nearer to the camera than this, m, all pixels are rendered."""


@dataclass(frozen=True)
class PoseWarps:
    """A body in some poses and the inverse skinning of each; renders of any camera share it.

    world_to_posed: rigid transforms. canonical_to_posed: skinning matrices. step_m: distance between samples, m.
    """

    skin: SkinGrid
    world_to_posed: Float[Tensor, "k 4 4"]
    canonical_to_posed: Float[Tensor, "k j 4 4"]
    inverse: InverseSkinning
    step_m: float


def build_pose_warps(
    field: RadianceField, body: Body, skin: SkinGrid, canonical_to_world: Float[Tensor, "k j 4 4"]
) -> PoseWarps:
    """Invert the skinning of at least one pose, by the field's method and on its device."""
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
    """Render premultiplied colour and alpha in [0, 1] of every pixel, on the field's device; the image is on the CPU.

    skin: skin grid of the body, from `build_skin_grid`, which takes a second; pass it to render many images. Without
    gradient.
    """
    skin = skin or build_skin_grid(body, skin_margin_m(body, occupancy.bounds_m.cpu().numpy()))
    return render_pose(field, occupancy, build_pose_warps(field, body, skin, canonical_to_world[None]), 0, camera)


def render_pose(
    field: RadianceField, occupancy: BinaryOccupancy, poses: PoseWarps, row: int, camera: Camera
) -> Float[Tensor, "h w 4"]:
    """Render one of the poses of `build_pose_warps`; otherwise like `render_field`."""
    posed_field = PosedField(field, poses.inverse, occupancy.to(field.bounds_m.device))
    world_to_posed = poses.world_to_posed[row]
    image = torch.zeros(camera.height, camera.width, 4)

    def render_chunk(rows: Tensor, columns: Tensor) -> None:
        pixels_px = torch.stack([columns, rows], dim=-1) + 0.5
        origins_m, directions = _transform_rays(*pixel_rays(camera, pixels_px), world_to_posed)
        with torch.no_grad():
            chunk_rgba = _render_chunk_rays(posed_field, poses, row, origins_m, directions)
        image[rows.cpu(), columns.cpu()] = chunk_rgba.cpu()

    chunks = _pixels_in_box(poses.inverse.posed_bounds_m[row], world_to_posed, camera)
    thread_count = torch.get_num_threads() if world_to_posed.device == CPU else 1
    shared_thread_pool(thread_count).map(render_chunk, *zip(*chunks, strict=True))
    return image


def _transform_rays(origins_m: Tensor, directions: Tensor, matrix: Float[Tensor, "4 4"]) -> tuple[Tensor, Tensor]:
    rotation = matrix[:3, :3]
    return origins_m @ rotation.T + matrix[:3, 3], directions @ rotation.T


def _pixels_in_box(
    box_m: Float[Tensor, "2 3"], world_to_posed: Float[Tensor, "4 4"], camera: Camera
) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield rows and columns of the pixels in the image of a box of posed space, in chunks."""
    corners_posed_m = box_m[0] + corner_offsets(box_m.device) * (box_m[1] - box_m[0])
    corners_m = (corners_posed_m - world_to_posed[:3, 3]) @ world_to_posed[:3, :3]
    corners_px, depth_m = project(corners_m, camera)
    x0, y0, x1, y1 = 0, 0, camera.width, camera.height
    if bool((depth_m > MIN_DEPTH_M).all()):
        x0, y0 = (max(0, int(value)) for value in corners_px.amin(0).floor())
        x1, y1 = (int(value) + 1 for value in corners_px.amax(0).ceil())
        x1, y1 = min(x1, camera.width), min(y1, camera.height)
    if x1 <= x0 or y1 <= y0:
        return
    pixels = torch.cartesian_prod(torch.arange(y0, y1), torch.arange(x0, x1)).to(box_m.device)
    for chunk in pixels.split(RAY_CHUNK_SIZE):
        yield chunk[:, 0], chunk[:, 1]


def _render_chunk_rays(
    posed_field: PosedField,
    poses: PoseWarps,
    row: int,
    origins_m: Float[Tensor, "n 3"],
    directions: Float[Tensor, "n 3"],
) -> Float[Tensor, "n 4"]:
    count, device = len(origins_m), origins_m.device
    frame, jitter = torch.full((count,), row, device=device), torch.full((count,), 0.5, device=device)
    rays = Rays(origins_m, directions, frame, jitter)
    if not posed_field.is_fused:
        return _render_in_sample_chunks(posed_field, poses, row, rays)
    pose_batch = PoseBatch(poses.skin, frame[:1], poses.canonical_to_posed[row : row + 1])
    rendered = render_rays(
        posed_field, rays, pose_batch, origins_m[:0], poses.step_m, MAX_SAMPLES_PER_RAY, FeatureGradients()
    )
    return torch.cat([rendered.image, rendered.alpha[:, None]], dim=-1)


def _render_in_sample_chunks(posed_field: PosedField, poses: PoseWarps, row: int, rays: Rays) -> Float[Tensor, "n 4"]:
    """Render rays of one pose with any field: evaluate samples from near to far and stop at `MAX_OPTICAL_DEPTH`."""
    step_m, device = poses.step_m, rays.origins_m.device
    samples = posed_field.inverse.sample_rays(rays, step_m, posed_field.occupancy, MAX_SAMPLES_PER_RAY)
    ray = segment_ids_from_counts(samples.ray_offsets.diff())
    pending, next_rank = torch.arange(len(ray), device=device), 0
    rank = pending - samples.ray_offsets[ray]
    colour, density = torch.zeros(len(ray), 3, device=device), torch.zeros(len(ray), device=device)
    optical_depth = torch.zeros(len(rays.origins_m), device=device)
    while len(pending):
        next_rank += SAMPLE_CHUNK_SIZE
        is_next = rank[pending] < next_rank
        rows, pending = pending[is_next], pending[~is_next]
        posed_m = rays.origins_m[ray[rows]] + samples.distance_m[rows, None] * rays.directions[ray[rows]]
        slot, frame_offsets = torch.tensor([row], device=device), torch.tensor([0, len(rows)], device=device)
        matrices, canonical_m = poses.canonical_to_posed[row : row + 1], samples.canonical_m[rows]
        points = posed_field.inverse.to_canonical(poses.skin, matrices, slot, canonical_m, posed_m, frame_offsets)
        colour[rows], density[rows] = posed_field.field(points)
        optical_depth.index_add_(0, ray[rows], density[rows] * step_m)
        pending = pending[optical_depth[ray[pending]] < MAX_OPTICAL_DEPTH]
    image, alpha, _ = composite(density, colour, torch.full_like(density, step_m), samples.ray_offsets)
    return torch.cat([image, alpha[:, None]], dim=-1)
