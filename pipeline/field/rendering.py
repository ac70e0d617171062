"""Full images of the canonical field in a pose."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.body.body import Body
from pipeline.core.device import CPU
from pipeline.field.field import Field
from pipeline.field.inverse_skinning import Inverse, Rays, invert_motion
from pipeline.field.occupancy import Occupancy
from pipeline.field.skin_grid import build_skin_grid, posed_from_world, skin_margin_m
from pipeline.field.volume_rendering import Placing, ends_with_the_light, look
from pipeline.geometry.camera import Camera, pixel_rays, project
from pipeline.kernels.common.grid_corners import corner_bits
from pipeline.kernels.common.packing import owner_of_each
from pipeline.kernels.common.thread_pool import Parallel
from pipeline.kernels.composite import composite
from pipeline.kernels.hashgrid import Towards
from pipeline.kernels.inverse_skinning import SkinGrid

RAYS_AT_ONCE = 1 << 13
STEPS_PER_HEIGHT, MAX_SAMPLES = 125, 256
SAMPLES_AT_ONCE = 8
"""Of each ray, near to far, before it is asked whether anything behind them can still be seen."""
OPAQUE = 9.0
"""Optical depth behind which a ray ends: an eight-thousandth of the light is left, a thirtieth of a grey level."""


@dataclass(frozen=True)
class Poses:
    """A body in some poses and the way back from each: what their renders share, whatever the camera.

    to_posed: rigid maps from the world to the posed spaces. canonical_to_posed: the skinning matrices there.
    """

    skin: SkinGrid
    to_posed: Float[Tensor, "k 4 4"]
    canonical_to_posed: Float[Tensor, "k j 4 4"]
    inverse: Inverse
    step_m: float


def undo_poses(field: Field, body: Body, skin: SkinGrid, canonical_to_world: Float[Tensor, "k j 4 4"]) -> Poses:
    """Invert the skinning of all poses, at least one, in the field's way, on the field's device."""
    device = field.bounds_m.device
    skin, canonical_to_world = skin.to(device), canonical_to_world.float().to(device)
    to_posed = posed_from_world(canonical_to_world)
    canonical_to_posed = to_posed[:, None] @ canonical_to_world
    inverse = invert_motion(field.inverse_skinning, body, skin, canonical_to_posed)
    return Poses(skin, to_posed, canonical_to_posed, inverse, body.height_m() / STEPS_PER_HEIGHT)


def render_field(
    field: Field,
    occupancy: Occupancy,
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
    return render_pose(field, occupancy, undo_poses(field, body, skin, canonical_to_world[None]), 0, camera)


def render_pose(field: Field, occupancy: Occupancy, poses: Poses, row: int, camera: Camera) -> Float[Tensor, "h w 4"]:
    """`render_field` of one of some poses whose skinning is inverted already."""
    occupancy, to_posed = occupancy.to(field.bounds_m.device), poses.to_posed[row]
    image = torch.zeros(camera.height, camera.width, 4)

    def show(rows: Tensor, columns: Tensor) -> None:
        pixels_px = torch.stack([columns, rows], dim=-1) + 0.5
        rays = _carry(*pixel_rays(camera, pixels_px), to_posed)
        with torch.no_grad():
            shaded = _shade(field, occupancy, poses, row, rays)
        image[rows.cpu(), columns.cpu()] = shaded.cpu()

    parts = _pixels_in_box(poses.inverse.boxes_m[row], to_posed, camera)
    _threads(torch.get_num_threads() if to_posed.device == CPU else 1).map(show, *zip(*parts, strict=True))
    return image


@cache
def _threads(count: int) -> Parallel:
    return Parallel(count)


def _carry(origins: Tensor, directions: Tensor, matrix: Float[Tensor, "4 4"]) -> tuple[Tensor, Tensor]:
    rotation = matrix[:3, :3]
    return origins @ rotation.T + matrix[:3, 3], directions @ rotation.T


def _pixels_in_box(
    box_m: Float[Tensor, "2 3"], to_posed: Float[Tensor, "4 4"], camera: Camera
) -> Iterator[tuple[Tensor, Tensor]]:
    """Rows and columns of the pixels that may see the posed box, in parts."""
    corners = (box_m[0] + corner_bits(box_m.device) * (box_m[1] - box_m[0]) - to_posed[:3, 3]) @ to_posed[:3, :3]
    corners_px, depth_m = project(corners, camera)
    x0, y0, x1, y1 = 0, 0, camera.width, camera.height
    if bool((depth_m > 0.05).all()):
        x0, y0 = (max(0, int(value)) for value in corners_px.amin(0).floor())
        x1, y1 = (int(value) + 1 for value in corners_px.amax(0).ceil())
        x1, y1 = min(x1, camera.width), min(y1, camera.height)
    if x1 <= x0 or y1 <= y0:
        return
    pixels = torch.cartesian_prod(torch.arange(y0, y1), torch.arange(x0, x1)).to(box_m.device)
    for part in pixels.split(RAYS_AT_ONCE):
        yield part[:, 0], part[:, 1]


def _shade(
    field: Field,
    occupancy: Occupancy,
    poses: Poses,
    row: int,
    rays: tuple[Tensor, Tensor],
) -> Float[Tensor, "n 4"]:
    origins, directions = rays
    count, device, step_m = len(origins), origins.device, poses.step_m
    frame, jitter = torch.full((count,), row, device=device), torch.full((count,), 0.5, device=device)
    if ends_with_the_light(field, poses.inverse):
        placing = Placing(poses.skin, frame[:1], poses.canonical_to_posed[row : row + 1])
        about = (occupancy, Rays(origins, directions, frame, jitter), placing, origins[:0])
        seen = look(field, poses.inverse, *about, step_m, MAX_SAMPLES, Towards())
        return torch.cat([seen.image, seen.alpha[:, None]], dim=-1)
    samples = poses.inverse.sample(Rays(origins, directions, frame, jitter), step_m, occupancy, MAX_SAMPLES)
    ray = owner_of_each(samples.ray_start.diff())
    waiting, reached = torch.arange(len(ray), device=device), 0
    rank = waiting - samples.ray_start[ray]
    colour, density = torch.zeros(len(ray), 3, device=device), torch.zeros(len(ray), device=device)
    optical_depth = torch.zeros(count, device=device)
    while len(waiting):
        reached += SAMPLES_AT_ONCE
        near = rank[waiting] < reached
        rows, waiting = waiting[near], waiting[~near]
        posed = origins[ray[rows]] + samples.distance_m[rows, None] * directions[ray[rows]]
        slot, slot_start = torch.tensor([row], device=device), torch.tensor([0, len(rows)], device=device)
        matrices, found = poses.canonical_to_posed[row : row + 1], samples.canonical_m[rows]
        points = poses.inverse.place(poses.skin, matrices, slot, found, posed, slot_start)
        colour[rows], density[rows] = field(points)
        optical_depth.index_add_(0, ray[rows], density[rows] * step_m)
        waiting = waiting[optical_depth[ray[waiting]] < OPAQUE]
    image, alpha, _ = composite(density, colour, torch.full_like(density, step_m), samples.ray_start)
    return torch.cat([image, alpha[:, None]], dim=-1)


def over_white(image: Float[Tensor, "h w 4"]) -> Float[Tensor, "h w 3"]:
    """Premultiplied colour and alpha over a white background."""
    return image[..., :3] + (1 - image[..., 3:])
