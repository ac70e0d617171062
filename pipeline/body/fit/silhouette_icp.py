"""Silhouette terms: points on the body's outline paired with points on the mask's outline (iterated closest points).

The body is drawn into the same small window as the mask, so that both outlines carry the same half-pixel error and it
cancels. Two kinds of pairs: every point of the body's outline belongs on the mask's outline, and every point of the
mask's outline wants the body's nearest outline with a similar normal. Outlines inside the body have no pair.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from scipy.spatial import cKDTree
from torch import Tensor

from pipeline.body.fit.camera_parameters import apply_intrinsics_delta
from pipeline.body.fit.energy import Contour, FitState, Observations
from pipeline.body.fit.linear_body import ACTIVE_JOINTS, LinearBody, pose_skeleton
from pipeline.geometry.camera import Camera, project
from pipeline.geometry.skinning import linear_blend_skinning, rigid_transform
from pipeline.kernels.raster import rasterize
from pipeline.metrics.images import mask_iou

PERSON_HEIGHT_PX = 240
"""Height of a person in a matching window, pixels."""

PAIRS_PER_DIRECTION = 120
"""Pairs a frame from the body's outline, and as many from the mask's."""

FRAME_WEIGHT = 40.0
"""What all pairs of a frame weigh together: outline points next to each other err alike."""

MAX_PAIR_DISTANCE_RATIO = 0.10
"""How far a pair may lie apart, as a share of the person's height."""

CLOTHING_WEIGHT = 0.5
"""Weight of pairs where the mask lies outside the body, as clothes do, against those where the body sticks out."""

HAIR_AND_SHOES_WEIGHT = 0.05
"""The same on head and feet: hair and shoes add to the outline's height, which must not pass for a person who is
nearer."""

HEAD_AND_FOOT_JOINTS = ("Head", "LeftFoot", "LeftToeBase", "RightFoot", "RightToeBase")

FULL_WEIGHT_IOU_DROP, MIN_WEIGHT_IOU_DROP = 0.05, 0.15
"""A frame's outlines count fully while its overlap is this near to the median, and hardly when it is that far below."""

MIN_MASK_WEIGHT = 0.05

SKIN_CHUNK = 32


@dataclass(frozen=True)
class MaskWindow:
    """One frame's mask in its matching window: signed distance to the outline (window pixels), its unit gradient, and
    the outline's pixels (row, column)."""

    left_px: int
    top_px: int
    scale: float
    mask: Bool[np.ndarray, "h w"]
    distance: Float[np.ndarray, "h w"]
    normal: Float[np.ndarray, "h w 2"]
    outline: Int[np.ndarray, "q 2"]
    person_px: float


def crop_mask_window(mask: UInt8[np.ndarray, "h w"]) -> MaskWindow | None:
    """Cut the person out of a mask and shrink it to `PERSON_HEIGHT_PX`; None when the mask is empty."""
    rows, columns = np.flatnonzero((mask > 127).any(1)), np.flatnonzero((mask > 127).any(0))
    if len(rows) == 0:
        return None
    person = max(int(rows[-1] - rows[0]) + 1, 8)
    margin = int(0.2 * person) + 2
    top, bottom = max(int(rows[0]) - margin, 0), min(int(rows[-1]) + margin, mask.shape[0])
    left, right = max(int(columns[0]) - margin, 0), min(int(columns[-1]) + margin, mask.shape[1])
    scale = min(1.0, PERSON_HEIGHT_PX / person)
    size = (max(1, round((right - left) * scale)), max(1, round((bottom - top) * scale)))
    small = cv2.resize(mask[top:bottom, left:right], size, interpolation=cv2.INTER_AREA) > 127
    distance = signed_distance(small)
    return MaskWindow(
        left, top, scale, small, distance, outward_normals(distance), outline_pixels(small), person * scale
    )


def signed_distance(inside: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Distance in pixels to the outline between pixel centres: positive outside, -0.5 on the innermost row."""
    return np.where(inside, 0.5 - distance_px(inside), distance_px(~inside) - 0.5).astype(np.float32)


def distance_px(area: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Euclidean distance in pixels of every pixel in an area to the nearest pixel outside; 0 outside.

    Runs without Intel IPP, which OpenCV uses for small images or a single thread: IPP rounds differently when its
    output is not aligned to 32 bytes, and malloc aligns to 16.
    """
    with_ipp = cv2.ipp.useIPP()
    cv2.ipp.setUseIPP(False)
    try:
        return cv2.distanceTransform(area.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    finally:
        cv2.ipp.setUseIPP(with_ipp)


def outline_pixels(inside: Bool[np.ndarray, "h w"]) -> Int[np.ndarray, "q 2"]:
    """(row, column) of inside pixels with an outside neighbour; the picture's border is no outline."""
    padded = np.pad(inside, 1, mode="edge")
    surrounded = padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
    return np.argwhere(inside & ~surrounded)


def outward_normals(distance: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w 2"]:
    """Unit gradient (x, y) of a signed distance, smoothed over a few pixels."""
    smooth = cv2.GaussianBlur(distance, (0, 0), 1.5)
    across, down = cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)
    # cv2.magnitude uses Intel IPP, whose rounding depends on the memory alignment of its output.
    length = np.maximum(np.sqrt(across * across + down * down), 1e-6)
    return np.stack([across / length, down / length], axis=-1)


def posed_vertices(model: LinearBody, state: FitState) -> Float[Tensor, "n v 3"]:
    """World vertices (float32) of the state's body in every frame."""
    posed = model.moved(state.shape)
    skeleton = pose_skeleton(posed, state.rotations, state.root_m)
    moved = (skeleton.rotation @ posed.joints[:, :, None]).squeeze(-1)
    transforms = rigid_transform(skeleton.rotation, skeleton.position - moved).float()
    vertices, weights = posed.vertices.float(), posed.weights.float()
    chunks = [linear_blend_skinning(vertices, weights, part) for part in transforms.split(SKIN_CHUNK)]
    return torch.cat(chunks)


@dataclass(frozen=True)
class BodyRaster:
    """The body drawn into a window: which face each pixel shows, and where on it."""

    face_id: Int[np.ndarray, "h w"]
    barycentric: Float[np.ndarray, "h w 3"]


def rasterise_in_window(
    vertices_world: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"], camera: Camera, window: MaskWindow
) -> BodyRaster:
    """Rasterise a posed body in a window's pixels."""
    vertices_px, depth_m = project(vertices_world, camera)
    corner = vertices_px.new_tensor([window.left_px, window.top_px])
    height, width = window.mask.shape
    face_id, barycentric, _ = rasterize((vertices_px - corner) * window.scale, depth_m, faces, height, width)
    return BodyRaster(face_id.numpy(), barycentric.numpy())


@dataclass(frozen=True)
class Correspondences:
    """Pairs of one frame, in window pixels (x, y)."""

    pixel: Int[np.ndarray, "m 2"]
    target: Float[np.ndarray, "m 2"]
    normal: Float[np.ndarray, "m 2"]
    weight: Float[np.ndarray, "m"]


def find_correspondences(
    window: MaskWindow, body_mask: Bool[np.ndarray, "h w"], is_head_or_foot: Bool[np.ndarray, "h w"]
) -> Correspondences:
    """Pairs between the outline of the drawn body and that of the mask (both kinds of the module's docstring).

    bulky: pixels of the body's head and feet.
    """
    body_outline = outline_pixels(body_mask)
    if len(body_outline) == 0 or len(window.outline) == 0:
        empty = np.zeros((0, 2))
        return Correspondences(empty.astype(np.int64), empty, empty, np.zeros(0))
    mask_normal, body_normal = window.normal, outward_normals(signed_distance(body_mask))
    max_distance = MAX_PAIR_DISTANCE_RATIO * window.person_px
    forward = _subsample(body_outline)
    normal = mask_normal[forward[:, 0], forward[:, 1]]
    gap = window.distance[forward[:, 0], forward[:, 1]] + 0.5
    agree = (normal * body_normal[forward[:, 0], forward[:, 1]]).sum(1) > 0.3
    first = Correspondences(
        forward,
        forward[:, ::-1] + 0.5 - gap[:, None] * normal,
        normal,
        ((np.abs(gap) < max_distance) & agree) * _clothing_weights(gap, is_head_or_foot[forward[:, 0], forward[:, 1]]),
    )
    backward = _subsample(window.outline)
    distance_px, nearest = cKDTree(body_outline).query(backward)
    partner = body_outline[nearest]
    normal = mask_normal[backward[:, 0], backward[:, 1]]
    gap = ((partner - backward)[:, ::-1] * normal).sum(1)
    agree = (normal * body_normal[partner[:, 0], partner[:, 1]]).sum(1) > 0.3
    second = Correspondences(
        partner,
        backward[:, ::-1] + 0.5,
        normal,
        ((distance_px < max_distance) & agree) * _clothing_weights(gap, is_head_or_foot[partner[:, 0], partner[:, 1]]),
    )
    return Correspondences(
        *(np.concatenate(pair) for pair in zip(vars(first).values(), vars(second).values(), strict=True))
    )


def _clothing_weights(gap: Float[np.ndarray, "m"], is_head_or_foot: Bool[np.ndarray, "m"]) -> Float[np.ndarray, "m"]:
    """Less weight where the mask lies outside the body (gap < 0): clothes, and even more so hair and shoes."""
    return np.where(gap < 0, np.where(is_head_or_foot, HAIR_AND_SHOES_WEIGHT, CLOTHING_WEIGHT), 1.0)


def _subsample(pixels: Int[np.ndarray, "q 2"]) -> Int[np.ndarray, "m 2"]:
    """About `PAIRS_PER_DIRECTION` of an outline's pixels, evenly along the scan order."""
    return pixels[np.linspace(0, len(pixels) - 1, min(PAIRS_PER_DIRECTION, len(pixels))).astype(np.int64)]


def mask_weights(silhouette_iou: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Share of each frame's outlines that counts: a mask that agrees much less with the body than others is doubtful.

    Frames without a mask (nan) get full trust, which multiplies nothing.
    """
    if np.isnan(silhouette_iou).all():
        return np.ones_like(silhouette_iou)
    iou_drop = np.nanmedian(silhouette_iou) - silhouette_iou
    return np.nan_to_num(
        np.clip((MIN_WEIGHT_IOU_DROP - iou_drop) / (MIN_WEIGHT_IOU_DROP - FULL_WEIGHT_IOU_DROP), MIN_MASK_WEIGHT, 1.0),
        nan=1.0,
    )


def match_silhouettes(
    model: LinearBody, state: FitState, observations: Observations, windows: Sequence[MaskWindow | None]
) -> tuple[Contour, Float[np.ndarray, "n"]]:
    """The contour term for the body as it stands, and each frame's overlap with its mask (nan without a mask)."""
    camera = apply_intrinsics_delta(observations.camera, state.intrinsics_delta)
    vertices = posed_vertices(model, state)
    carried = model.weights[:, [ACTIVE_JOINTS.index(name) for name in HEAD_AND_FOOT_JOINTS]].sum(1)
    head_and_foot_faces = (carried > 0.5)[model.faces[:, 0].long()].numpy()
    size = 2 * PAIRS_PER_DIRECTION
    frames = len(windows)
    corners = torch.zeros(frames, size, 3, dtype=torch.int64)
    barycentric, target = torch.zeros(frames, size, 3).double(), torch.zeros(frames, size, 2).double()
    normal, weight = torch.zeros(frames, size, 2).double(), torch.zeros(frames, size).double()
    silhouette_iou = np.full(frames, np.nan)
    for frame, window in enumerate(windows):
        if window is None:
            continue
        body_raster = rasterise_in_window(vertices[frame], model.faces, camera, window)
        body_mask = body_raster.face_id >= 0
        silhouette_iou[frame] = mask_iou(body_mask, window.mask)
        pairs = find_correspondences(window, body_mask, body_mask & head_and_foot_faces[body_raster.face_id])
        count, used = len(pairs.weight), (pairs.weight > 0).sum()
        rows, columns = pairs.pixel.T
        corners[frame, :count] = model.faces[body_raster.face_id[rows, columns]].long()
        barycentric[frame, :count] = torch.from_numpy(body_raster.barycentric[rows, columns]).double()
        target[frame, :count] = torch.from_numpy(pairs.target / window.scale + [window.left_px, window.top_px])
        normal[frame, :count] = torch.from_numpy(pairs.normal).double()
        weight[frame, :count] = torch.from_numpy(pairs.weight * (FRAME_WEIGHT / max(used, 1)))
    weight *= torch.from_numpy(mask_weights(silhouette_iou))[:, None]
    return Contour(corners, barycentric, target, normal, weight), silhouette_iou
