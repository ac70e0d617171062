"""Full images of the canonical field in a pose."""

from collections.abc import Iterator

import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.avatar.body import Body
from pipeline.avatar.field import Field
from pipeline.avatar.occupancy import Occupancy
from pipeline.avatar.warp import build_skin_grid, posed_from_world, skin_margin_m
from pipeline.geometry.camera import Camera, pixel_rays, project
from pipeline.kernels.composite import composite
from pipeline.kernels.march import WarpSet, march
from pipeline.kernels.warp import SkinGrid, bake, newton

RAYS_AT_ONCE = 1 << 14
STEPS_PER_HEIGHT = 250


def render_field(
    field: Field,
    occupancy: Occupancy,
    body: Body,
    canonical_to_world: Float[Tensor, "j 4 4"],
    camera: Camera,
    skin: SkinGrid | None = None,
) -> Float[Tensor, "h w 4"]:
    """Premultiplied colour and alpha of every pixel, without gradient.

    skin: the body's skin grid, from `build_skin_grid`; give it when many images are rendered, it takes a second to
    build.
    """
    skin = skin or build_skin_grid(body, skin_margin_m(body, occupancy.bounds_m.numpy()))
    canonical_to_world = canonical_to_world.float()
    to_posed = posed_from_world(canonical_to_world[None])[0]
    canonical_to_posed = to_posed @ canonical_to_world
    warps = WarpSet.of([bake(skin, canonical_to_posed)], skin.cell_m)
    blended = skin.blend(canonical_to_posed[None])
    step_m = body.height_m() / STEPS_PER_HEIGHT
    image = torch.zeros(camera.height, camera.width, 4)
    for rows, columns in _pixels_in_box(warps, to_posed, camera):
        pixels_px = torch.stack([columns, rows], dim=-1) + 0.5
        rays = _carry(*pixel_rays(camera, pixels_px), to_posed)
        with torch.no_grad():
            image[rows, columns] = _shade(field, occupancy, skin, blended, warps, rays, step_m)
    return image


def _carry(origins: Tensor, directions: Tensor, matrix: Float[Tensor, "4 4"]) -> tuple[Tensor, Tensor]:
    rotation = matrix[:3, :3]
    return origins @ rotation.T + matrix[:3, 3], directions @ rotation.T


def _pixels_in_box(warps: WarpSet, to_posed: Float[Tensor, "4 4"], camera: Camera) -> Iterator[tuple[Tensor, Tensor]]:
    """Rows and columns of the pixels that may see the posed box, in parts."""
    low = torch.from_numpy(warps.origin_m[0])
    high = low + warps.cell_m * torch.from_numpy(warps.dims[0] - 1)
    unit = torch.tensor([[i & 1, i >> 1 & 1, i >> 2 & 1] for i in range(8)])
    corners = (low + unit * (high - low) - to_posed[:3, 3]) @ to_posed[:3, :3]
    corners_px, depth_m = project(corners, camera)
    x0, y0, x1, y1 = 0, 0, camera.width, camera.height
    if bool((depth_m > 0.05).all()):
        x0, y0 = (max(0, int(value)) for value in corners_px.amin(0).floor())
        x1, y1 = (int(value) + 1 for value in corners_px.amax(0).ceil())
        x1, y1 = min(x1, camera.width), min(y1, camera.height)
    if x1 <= x0 or y1 <= y0:
        return
    pixels = torch.cartesian_prod(torch.arange(y0, y1), torch.arange(x0, x1))
    for part in pixels.split(RAYS_AT_ONCE):
        yield part[:, 0], part[:, 1]


def _shade(
    field: Field,
    occupancy: Occupancy,
    skin: SkinGrid,
    blended: Tensor,
    warps: WarpSet,
    rays: tuple[Tensor, Tensor],
    step_m: float,
) -> Float[Tensor, "n 4"]:
    origins, directions = rays
    count = len(origins)
    frame, jitter = torch.zeros(count, dtype=torch.long), torch.full((count,), 0.5)
    samples = march(
        origins, directions, frame, jitter, step_m, warps, occupancy.occupied, occupancy.bounds_m, max_samples=256
    )
    ray = torch.repeat_interleave(torch.arange(count), samples.ray_start.diff())
    posed = origins[ray] + samples.distance_m[:, None] * directions[ray]
    slot_start = torch.tensor([0, len(ray)])
    points = newton(blended, samples.canonical_m, posed, slot_start, skin)
    colour, density = field(points)
    image, alpha, _ = composite(density, colour, torch.full_like(density, step_m), samples.ray_start)
    return torch.cat([image, alpha[:, None]], dim=-1)


def over_white(image: Float[Tensor, "h w 4"]) -> Float[Tensor, "h w 3"]:
    """Premultiplied colour and alpha over a white background."""
    return image[..., :3] + (1 - image[..., 3:])
