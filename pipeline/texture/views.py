"""Views for the bake: frames cropped to the posed mesh, per-pixel confidence, alignment to a render by optical flow."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from pipeline.geometry.camera import Camera, pixel_footprint_m, project
from pipeline.geometry.colour import linear_to_srgb, srgb_to_linear
from pipeline.geometry.creases import Creases
from pipeline.geometry.mesh import area_weighted_vertex_normals
from pipeline.geometry.surface_cut import SurfaceCut
from pipeline.texture.light import MIN_IRRADIANCE

MIN_FOREGROUND_ALPHA = 0.9
"""From this alpha on, a pixel shows the person only."""

DEPTH_DISCONTINUITY_M = 0.03
"""Depth range within 3 x 3 pixels above which a pixel is at an occlusion boundary."""

CROP_MARGIN_PX = 12

FLOW_DIVISOR = 2
"""The flow is smoothed over a centimetre: at half the size it is as good (docs/decisions/texture.md)."""


@dataclass(frozen=True)
class BakeView:
    """One frame, cropped to the person.

    Attributes:
        image: sRGB, 0 to 255.
        mask: alpha of the person, 0 to 255.
        camera: of the crop.
        vertices_world: the posed mesh, m.
        view_cosine: cosine between each vertex normal and the direction to the camera.
        weight: of the whole frame; 1 for the median frame.
        shading: of each vertex, linear: irradiance (RGB, relative to the mean of the video), and the radiance of its
            highlight where the surface has any. None: colours are taken as they are.
    """

    image: UInt8[np.ndarray, "h w 3"]
    mask: UInt8[np.ndarray, "h w"]
    camera: Camera
    vertices_world: Float[Tensor, "v 3"]
    view_cosine: Float[Tensor, "v"]
    weight: float = 1.0
    shading: Float[Tensor, "v d"] | None = None

    def with_mesh(self, vertices_world: Float[Tensor, "w 3"], faces: Int[np.ndarray, "f 3"]) -> "BakeView":
        """Return the view of another mesh in the same pose; vertices_world: m."""
        cosine = vertex_view_cosine(vertices_world, torch.from_numpy(faces), self.camera)
        return replace(self, vertices_world=vertices_world, view_cosine=cosine)

    def cut(self, cut: SurfaceCut) -> "BakeView":
        """Return the view of the mesh that was cut for its atlas."""
        return self.with_mesh(torch.from_numpy(cut.extend(self.vertices_world.numpy())), cut.faces)

    def split(self, creases: Creases) -> "BakeView":
        """Return the view of the mesh with copies of the vertices on its folds."""
        return self.with_mesh(self.vertices_world[torch.from_numpy(creases.source)], creases.faces)


def crop_bake_view(
    image: UInt8[np.ndarray, "h w 3"],
    mask: UInt8[np.ndarray, "h w"],
    camera: Camera,
    vertices_world: Float[Tensor, "v 3"],
    faces: Int[Tensor, "f 3"],
) -> BakeView:
    """Crop a frame to the bounding box of the posed mesh plus `CROP_MARGIN_PX`.

    image: sRGB, 0 to 255. mask: 0 to 255. vertices_world: m.
    """
    position_px, _ = project(vertices_world, camera)
    low = torch.floor(position_px.amin(dim=0)).int().tolist()
    high = torch.ceil(position_px.amax(dim=0)).int().tolist()
    left, top = (
        min(max(value - CROP_MARGIN_PX, 0), side - 1)
        for value, side in zip(low, (camera.width, camera.height), strict=True)
    )
    right, bottom = (
        min(max(high[0] + CROP_MARGIN_PX, left + 1), camera.width),
        min(max(high[1] + CROP_MARGIN_PX, top + 1), camera.height),
    )
    window = (slice(top, bottom), slice(left, right))
    return BakeView(
        np.ascontiguousarray(image[window]),
        np.ascontiguousarray(mask[window]),
        camera.cropped(left, top, right - left, bottom - top),
        vertices_world,
        vertex_view_cosine(vertices_world, faces, camera),
    )


def vertex_view_cosine(
    vertices_world: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"], camera: Camera
) -> Float[Tensor, "v"]:
    """Return the cosine between each area-weighted vertex normal and the direction to the camera, in [-1, 1]."""
    to_camera = torch.from_numpy(camera.centre_m()).to(vertices_world) - vertices_world
    normals = area_weighted_vertex_normals(vertices_world, faces)
    return (normals * torch.nn.functional.normalize(to_camera, dim=1)).sum(dim=1)


def weight_by_resolution(views: Sequence[BakeView]) -> list[BakeView]:
    """Return the views weighted by their pixels per square metre on the person, relative to the median view (1)."""
    footprints_m = np.array([pixel_footprint_m(view.vertices_world, view.camera) for view in views])
    weights = (np.median(footprints_m) / footprints_m) ** 2
    return [replace(view, weight=float(weight)) for view, weight in zip(views, weights, strict=True)]


def pixel_confidence(
    mask: UInt8[np.ndarray, "h w"], depth_m: Float[np.ndarray, "h w"], falloff_px: float
) -> Float[np.ndarray, "h w"]:
    """Return how reliably each pixel shows the surface under it, in [0, 1].

    0 outside the mask, at silhouettes and at occlusion boundaries; rises linearly to 1 at `falloff_px` from them.

    depth_m: of the posed mesh, inf outside it.
    """
    kernel = np.ones((3, 3), np.uint8)
    on_mesh = np.isfinite(depth_m)
    nearest = cv2.erode(np.where(on_mesh, depth_m, np.float32(1e9)), kernel)
    farthest = cv2.dilate(np.where(on_mesh, depth_m, np.float32(0.0)), kernel)
    unoccluded = on_mesh & (mask >= 255 * MIN_FOREGROUND_ALPHA) & (farthest - nearest < DEPTH_DISCONTINUITY_M)
    distance_px = cv2.distanceTransform(unoccluded.astype(np.uint8), cv2.DIST_L2, 3)
    return np.clip((distance_px - 1.0) / falloff_px, 0.0, 1.0).astype(np.float32)


def remove_light(colour: Float[np.ndarray, "*n 3"], shading: Float[np.ndarray, "*n d"]) -> Float[np.ndarray, "*n 3"]:
    """Return the albedo (sRGB, at least 0) of surfaces that have this colour (sRGB in [0, 1]) under this shading."""
    diffuse = srgb_to_linear(np.maximum(colour, 0.0)) - shading[..., 3:].sum(axis=-1, keepdims=True)
    return linear_to_srgb(np.maximum(diffuse, 0.0) / np.maximum(shading[..., :3], MIN_IRRADIANCE)).astype(np.float32)


def align_to_render(
    view: BakeView, rendered: Float[np.ndarray, "h w 4"], smoothing_sigma_px: float, max_flow_px: float
) -> tuple[Float[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]:
    """Warp the image (in [0, 1]) and mask of a view onto a render by smoothed optical flow (DIS).

    The flow is computed at half the size; both are composited on grey before it, so that silhouettes contribute as well
    as texture. DIS splits the image into a stripe for each thread of OpenCV, and its result depends on the split: the
    caller gives it one thread.

    rendered: premultiplied colour and alpha, in [0, 1]. max_flow_px: largest displacement; 0 leaves the view unchanged.
    """
    colour, mask = view.image.astype(np.float32) / 255.0, view.mask
    if max_flow_px == 0:
        return colour, mask
    height, width = mask.shape
    small_size = max(width // FLOW_DIVISOR, 1), max(height // FLOW_DIVISOR, 1)
    scale = np.divide(small_size, (width, height), dtype=np.float32)
    small_render, small_image, small_mask = (
        cv2.resize(pixels, small_size, interpolation=cv2.INTER_AREA) for pixels in (rendered, view.image, mask)
    )
    flow_px = _optical_flow_px(
        _composite_on_grey(small_render[..., :3], small_render[..., 3]),
        _composite_image_on_grey(small_image.astype(np.float32) / 255.0, small_mask),
    )
    if smoothing_sigma_px > 0:
        flow_px = cv2.GaussianBlur(flow_px, (0, 0), smoothing_sigma_px * float(scale[1]))
    flow_px /= scale
    length_px = np.linalg.norm(flow_px, axis=2, keepdims=True)
    flow_px *= np.minimum(1.0, max_flow_px / np.maximum(length_px, 1e-6))
    flow_px = cv2.resize(flow_px, (width, height), interpolation=cv2.INTER_LINEAR)
    columns, rows = (np.arange(side, dtype=np.float32) for side in (width, height))
    position_px = flow_px[..., 0] + columns, flow_px[..., 1] + rows[:, None]
    warped = cv2.remap(colour, *position_px, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    warped_mask = cv2.remap(mask, *position_px, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    return np.clip(warped, 0.0, 1.0, out=warped), warped_mask


def _composite_on_grey(premultiplied: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(((premultiplied + 0.5 * (1.0 - alpha[..., None])) * 255.0).astype(np.uint8), cv2.COLOR_RGB2GRAY)


def _composite_image_on_grey(colour: np.ndarray, mask: np.ndarray) -> np.ndarray:
    alpha = mask.astype(np.float32) / 255.0
    return _composite_on_grey(colour * alpha[..., None], alpha)


def _optical_flow_px(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the displacement from each pixel of the first grey image to its match in the second."""
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    return flow.calc(first, second, np.zeros((*first.shape, 2), np.float32))
