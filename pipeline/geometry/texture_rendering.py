"""Rendering of a textured mesh, and turntable cameras."""

import math

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.geometry.camera import Camera, project
from pipeline.geometry.colour import linear_to_srgb, srgb_to_linear
from pipeline.kernels.raster import rasterize
from pipeline.kernels.texture_sampling import supersample_attributes, supersample_texture
from pipeline.kernels.texture_sampling.reference import sample_texture_reference


def sample_texture(texture: Float[Tensor, "th tw c"], uv: Float[Tensor, "n 2"]) -> Float[Tensor, "n c"]:
    """Sample a texture bilinearly; differentiable in both arguments.

    The UV origin is bottom-left, row 0 of the texture is at the top (v = 1), texel centres are at +0.5. Outside [0, 1]
    the border texel is repeated.

    >>> sample_texture(torch.tensor([[[1.0], [0.0]]]), torch.tensor([[0.25, 0.5], [0.5, 0.5]])).tolist()
    [[1.0], [0.5]]
    """
    return sample_texture_reference(texture, uv)


def render_textured(
    vertices_world: Float[Tensor, "v 3"],
    faces: Int[Tensor, "f 3"],
    faces_uv: Int[Tensor, "f 3"],
    uv: Float[Tensor, "t 2"],
    texture: Float[Tensor, "th tw c"],
    camera: Camera,
    supersampling: int = 3,
    shading: Float[Tensor, "v d"] | None = None,
) -> Float[Tensor, "h w c+1"]:
    """Render the texture: colours premultiplied by coverage, then the coverage, all in [0, 1].

    Each pixel is the mean of `supersampling` x `supersampling` bilinear samples, which antialiases silhouettes, seams
    and texels. The texture is shown without lighting, or shaded in linear RGB by the mean irradiance of the pixel.

    Args:
        vertices_world: posed vertices, m.
        faces: corners of each face, indices into the vertices.
        faces_uv: corners of the same faces, indices into `uv`.
        uv: texture coordinates in [0, 1], origin bottom-left.
        texture: colours in [0, 1], row 0 at the top.
        camera: the camera.
        supersampling: samples per pixel along each axis.
        shading: of each vertex, linear; needs a texture with three channels. Three columns: irradiance, 1 shows the
            texture as it is. A fourth: radiance that is added to all channels.
    """
    image = texture.new_zeros(camera.height, camera.width, texture.shape[2] + 1)
    box = _pixel_box(vertices_world, camera)
    if box is None:
        return image
    rows, columns = box
    crop = camera.cropped(columns.start, rows.start, columns.stop - columns.start, rows.stop - rows.start)
    fine = crop.scaled(float(supersampling))
    vertices_px, depth_m = project(vertices_world, fine)
    face_id, barycentric, _ = rasterize(vertices_px, depth_m, faces, fine.height, fine.width)
    drawn = supersample_texture(face_id, barycentric, faces_uv, uv, texture, supersampling)
    if shading is not None:
        drawn = apply_shading(drawn, supersample_attributes(face_id, barycentric, faces, shading, supersampling))
    image[box] = drawn
    return image


def apply_shading(unlit: Float[Tensor, "h w 4"], shading: Float[Tensor, "h w d"]) -> Float[Tensor, "h w 4"]:
    """Shade a premultiplied sRGB image in linear RGB; see `render_textured`, but one row of shading a pixel."""
    seen = unlit[..., 3] > 0
    coverage, light = unlit[seen][:, 3:], shading[seen]
    linear = srgb_to_linear(unlit[seen][:, :3] / coverage) * light[:, :3] + light[:, 3:].sum(dim=-1, keepdim=True)
    lit = unlit.clone()
    lit[seen] = torch.cat([linear_to_srgb(linear.clamp(0.0, 1.0)) * coverage, coverage], dim=-1)
    return lit


def _pixel_box(vertices_world: Float[Tensor, "v 3"], camera: Camera) -> tuple[slice, slice] | None:
    """Return rows and columns of the pixels that a mesh can cover; None where there are none.

    The whole image where a vertex is not in front of the camera.
    """
    position_px, depth_m = project(vertices_world, camera)
    if not bool((depth_m > 0).all()) or not bool(position_px.isfinite().all()):
        return slice(0, camera.height), slice(0, camera.width)
    low, high = position_px.amin(dim=0).floor().int().tolist(), position_px.amax(dim=0).ceil().int().tolist()
    left, top, right, bottom = max(low[0], 0), max(low[1], 0), min(high[0], camera.width), min(high[1], camera.height)
    return (slice(top, bottom), slice(left, right)) if left < right and top < bottom else None


def blur_coverage(
    premultiplied: Float[np.ndarray, "h w channels"], sigma_px: float
) -> Float[np.ndarray, "h w channels"]:
    """Blur the coverage of a render, which is its last channel, as lens and matting blur the mask of a frame.

    Colours of covered pixels are not blurred, because a texture baked from images already contains their blur. Colours
    of uncovered pixels are extrapolated from covered ones.

    Args:
        premultiplied: premultiplied colours and coverage in [0, 1].
        sigma_px: standard deviation of the Gaussian.
    """
    if sigma_px <= 0.0:
        return premultiplied
    size = 2 * math.ceil(4.0 * sigma_px) + 1
    rows, columns = (np.flatnonzero(premultiplied[..., -1].any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return premultiplied
    box = tuple(slice(max(0, each[0] - size), each[-1] + 1 + size) for each in (rows, columns))
    sharp, softer = premultiplied[box], np.zeros_like(premultiplied)
    blurred = cv2.GaussianBlur(sharp, (size, size), sigma_px, borderType=cv2.BORDER_REPLICATE)
    coverage, softened = sharp[..., -1:], blurred[..., -1:]
    extrapolated = blurred[..., :-1] / np.maximum(softened, 1e-6)
    own = sharp[..., :-1] / np.maximum(coverage, 1e-6)
    colour = np.where(coverage > 0.5, own, extrapolated)
    softer[box] = np.concatenate([colour * softened, softened], axis=2)
    return softer


def turntable_camera(
    box_min_m: Float[np.ndarray, "3"],
    box_max_m: Float[np.ndarray, "3"],
    angle_rad: float,
    width_px: int,
    height_px: int,
) -> Camera:
    """Return a camera with a long focal length on a circle around a box, at the height of the centre of the box.

    The whole box is in the image at every angle.

    Args:
        box_min_m, box_max_m: corners of the box in the world, +Y up, m.
        angle_rad: angle around +Y; at 0 the camera is on +Z and shows the front, at pi/2 it is on +X.
        width_px, height_px: size of the image.
    """
    centre, size = 0.5 * (box_min_m + box_max_m), box_max_m - box_min_m
    radius = 0.5 * math.hypot(size[0], size[2])
    distance = 6.0 * max(size[1], 2.0 * radius)
    focal_px = 0.94 * (distance - radius) * min(height_px / size[1], width_px / (2.0 * radius))
    backward = np.array([math.sin(angle_rad), 0.0, math.cos(angle_rad)])
    right = np.array([math.cos(angle_rad), 0.0, -math.sin(angle_rad)])
    world_to_camera = np.eye(4, dtype=np.float32)
    world_to_camera[:3, :3] = np.stack([right, [0.0, -1.0, 0.0], -backward])
    world_to_camera[:3, 3] = -world_to_camera[:3, :3] @ (centre + distance * backward)
    return Camera(focal_px, focal_px, width_px / 2.0, height_px / 2.0, width_px, height_px, world_to_camera)


def turntable_cameras(
    box_min_m: Float[np.ndarray, "3"], box_max_m: Float[np.ndarray, "3"], views: int, height_px: int
) -> list[Camera]:
    """Return cameras at evenly spaced azimuths, the first on +Z; the images are wide enough for the box at every angle.

    Args:
        box_min_m, box_max_m: corners of the box in the world, +Y up, m.
        views: number of cameras.
        height_px: height of the images.
    """
    size = box_max_m - box_min_m
    width_px = math.ceil(height_px * (math.hypot(size[0], size[2]) / size[1]))
    angles_rad = (2.0 * math.pi * number / views for number in range(views))
    return [turntable_camera(box_min_m, box_max_m, angle_rad, width_px, height_px) for angle_rad in angles_rad]
