"""Frames ready for baking: cropped to the posed mesh, with the trust that each pixel deserves, moved onto a render."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from pipeline.geometry.camera import Camera, pixel_footprint_m, project
from pipeline.geometry.mesh import area_weighted_vertex_normals
from pipeline.kernels.raster import rasterize

MIN_FOREGROUND_ALPHA = 0.9
"""A pixel belongs to the person alone from this alpha on."""

DEPTH_DISCONTINUITY_M = 0.03
"""A depth range within 3 x 3 pixels above this is a border between a nearer and a farther part."""


@dataclass(frozen=True)
class BakeView:
    """One frame, cropped to the person.

    image, mask: 0..255. vertices_world: the posed mesh, m. cosine: between each vertex's normal and the way to the
    camera. weight: of the whole frame, 1 for an ordinary one.
    """

    image: UInt8[np.ndarray, "h w 3"]
    mask: UInt8[np.ndarray, "h w"]
    camera: Camera
    vertices_world: Float[Tensor, "v 3"]
    view_cosine: Float[Tensor, "v"]
    weight: float = 1.0


def crop_bake_view(
    image: UInt8[np.ndarray, "h w 3"],
    mask: UInt8[np.ndarray, "h w"],
    camera: Camera,
    vertices_world: Float[Tensor, "v 3"],
    faces: Int[Tensor, "f 3"],
    margin_px: int = 12,
) -> BakeView:
    """The part of a frame that shows the posed mesh, with a margin."""
    position_px, _ = project(vertices_world, camera)
    low = torch.floor(position_px.amin(dim=0)).int().tolist()
    high = torch.ceil(position_px.amax(dim=0)).int().tolist()
    left, top = (
        min(max(value - margin_px, 0), side - 1) for value, side in zip(low, (camera.width, camera.height), strict=True)
    )
    right, bottom = (
        min(max(high[0] + margin_px, left + 1), camera.width),
        min(max(high[1] + margin_px, top + 1), camera.height),
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
    """Cosine between each vertex's area-weighted normal and the way to the camera; negative when it looks away."""
    to_camera = torch.from_numpy(camera.centre_m()).to(vertices_world) - vertices_world
    return (area_weighted_vertex_normals(vertices_world, faces) * torch.nn.functional.normalize(to_camera, dim=1)).sum(
        dim=1
    )


def weight_by_resolution(views: Sequence[BakeView]) -> list[BakeView]:
    """The views with the weight that the number of pixels a square metre gives them, 1 for the median."""
    footprints_m = np.array([pixel_footprint_m(view.vertices_world, view.camera) for view in views])
    weights = (np.median(footprints_m) / footprints_m) ** 2
    return [replace(view, weight=float(weight)) for view, weight in zip(views, weights, strict=True)]


def pixel_confidence(
    mask: UInt8[np.ndarray, "h w"], depth_m: Float[np.ndarray, "h w"], edge_px: float
) -> Float[np.ndarray, "h w"]:
    """How far a pixel is from other surfaces: 0 at silhouettes, occlusion borders and outside, 1 well inside."""
    kernel = np.ones((3, 3), np.uint8)
    seen = np.isfinite(depth_m)
    nearest = cv2.erode(np.where(seen, depth_m, np.float32(1e9)), kernel)
    farthest = cv2.dilate(np.where(seen, depth_m, np.float32(0.0)), kernel)
    unoccluded = seen & (mask >= 255 * MIN_FOREGROUND_ALPHA) & (farthest - nearest < DEPTH_DISCONTINUITY_M)
    distance_px = cv2.distanceTransform(unoccluded.astype(np.uint8), cv2.DIST_L2, 3)
    return np.clip((distance_px - 1.0) / edge_px, 0.0, 1.0).astype(np.float32)


def render_depth(view: BakeView, faces: Int[Tensor, "f 3"]) -> Float[Tensor, "h w"]:
    """Depth (m) of the posed mesh in every pixel of the view, inf where there is none."""
    vertices_px, depth_m = project(view.vertices_world, view.camera)
    return rasterize(vertices_px, depth_m, faces, view.camera.height, view.camera.width)[2]


def align_to_render(
    view: BakeView, rendered: Float[np.ndarray, "h w 4"], smoothing_sigma_px: float, max_flow_px: float
) -> tuple[Float[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]:
    """A view's image and mask, moved onto a rendered picture (premultiplied colour, alpha) by smoothed optical flow.

    Both are laid on grey first, so that silhouettes pull as well as texture does. No pixel moves by more than
    `max_flow_px`; 0 leaves the view as it is.
    """
    colour, mask = view.image.astype(np.float32) / 255.0, view.mask
    if max_flow_px == 0:
        return colour, mask
    flow_px = _flow_px(_composite_on_grey(rendered[..., :3], rendered[..., 3]), _composite_image_on_grey(colour, mask))
    if smoothing_sigma_px > 0:
        flow_px = cv2.GaussianBlur(flow_px, (0, 0), smoothing_sigma_px)
    length_px = np.linalg.norm(flow_px, axis=2, keepdims=True)
    flow_px *= np.minimum(1.0, max_flow_px / np.maximum(length_px, 1e-6))
    rows, columns = np.mgrid[: mask.shape[0], : mask.shape[1]].astype(np.float32)
    sample_positions_px = (columns + flow_px[..., 0], rows + flow_px[..., 1])
    warped = cv2.remap(colour, *sample_positions_px, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    warped_mask = cv2.remap(mask, *sample_positions_px, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    return np.clip(warped, 0.0, 1.0), warped_mask


def _composite_on_grey(premultiplied: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(((premultiplied + 0.5 * (1.0 - alpha[..., None])) * 255.0).astype(np.uint8), cv2.COLOR_RGB2GRAY)


def _composite_image_on_grey(colour: np.ndarray, mask: np.ndarray) -> np.ndarray:
    alpha = mask.astype(np.float32) / 255.0
    return _composite_on_grey(colour * alpha[..., None], alpha)


def _flow_px(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Where each pixel of the first grey picture lies in the second, relative to itself."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # DIS cuts the picture into one stripe a thread, and its result depends on the cut
    try:
        flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        return flow.calc(first, second, np.zeros((*first.shape, 2), np.float32))
    finally:
        cv2.setNumThreads(threads)
