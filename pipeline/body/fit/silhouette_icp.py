"""Silhouette correspondences: iterative closest points (ICP) between the outlines of the body and of the mask.

The body is rasterised into the same small window as the mask, so that both outlines have the same half-pixel error,
which cancels. Every point of the body outline is matched with the mask outline, and every point of the mask outline
with the nearest body outline of similar normal. Outlines inside the body are not matched, and those of legs that
something hides have little weight (`pipeline.body.fit.detections.hidden_legs`).
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
from pipeline.body.fit.detections.hidden_legs import outline_weights
from pipeline.body.fit.linear_body import ACTIVE_JOINTS, LinearBody
from pipeline.body.fit.posed_points import Contour, pose_skeleton
from pipeline.body.fit.state import FitState, Observations
from pipeline.geometry.camera import Camera, project
from pipeline.geometry.skinning import rigid_transform
from pipeline.kernels.common.thread_pool import shared_thread_pool
from pipeline.kernels.raster import rasterize
from pipeline.metrics.images import mask_iou

PERSON_HEIGHT_PX = 240
"""Height of a person in a matching window."""

PAIRS_PER_DIRECTION = 120
"""Pairs in a frame from the body outline, and as many from the mask outline."""

FRAME_WEIGHT = 40.0
"""Sum of the weights of all pairs in a frame: errors of adjacent outline points are correlated."""

MAX_PAIR_DISTANCE_RATIO = 0.10
"""Maximum distance of a pair, over the height of the person."""

CLOTHING_WEIGHT = 0.5
"""Weight of pairs with the mask outside the body, as with clothes, relative to pairs with the body outside the mask."""

HAIR_AND_SHOES_WEIGHT = 0.05
"""The same on head and feet: hair and shoes make the silhouette taller, which would move the person to the camera."""

SKIRT_TOP = -0.25
"""Height up to which a skirt may hide the body, as of `Body.height_on_legs_m`."""

SKIRT_JOINTS = ("Hips", "LeftUpLeg", "LeftLeg", "RightUpLeg", "RightLeg")

HEAD_AND_FOOT_JOINTS = ("Head", "LeftFoot", "LeftToeBase", "RightFoot", "RightToeBase")

FULL_WEIGHT_IOU_DROP, MIN_WEIGHT_IOU_DROP = 0.05, 0.15
"""Differences of a frame's IoU below the median: up to the first its pairs have full weight, from the second
`MIN_MASK_WEIGHT`."""

MIN_MASK_WEIGHT = 0.05

SKIN_CHUNK = 8
"""Frames that are skinned and matched in one go."""


@dataclass(frozen=True)
class MaskWindow:
    """Mask of one frame in its matching window.

    left_px, top_px: corner of the window in the image. scale_xy: window pixels per image pixel, across and down.
    distance: signed distance to the outline (window pixels, positive outside); normal: its unit gradient (x, y).
    outline: pixels (row, column) of the outline. person_px: height of the person in window pixels.
    """

    left_px: int
    top_px: int
    scale_xy: Float[np.ndarray, "2"]
    mask: Bool[np.ndarray, "h w"]
    distance: Float[np.ndarray, "h w"]
    normal: Float[np.ndarray, "h w 2"]
    outline: Int[np.ndarray, "q 2"]
    person_px: float


def crop_mask_window(mask: UInt8[np.ndarray, "h w"]) -> MaskWindow | None:
    """Crop a mask to the person and downscale it to `PERSON_HEIGHT_PX`; None if the mask is empty.

    mask: 0 to 255; the person is above 127.
    """
    rows, columns = np.flatnonzero((mask > 127).any(1)), np.flatnonzero((mask > 127).any(0))
    if len(rows) == 0:
        return None
    person = max(int(rows[-1] - rows[0]) + 1, 8)
    margin = int(0.2 * person) + 2
    top, bottom = max(int(rows[0]) - margin, 0), min(int(rows[-1]) + margin, mask.shape[0])
    left, right = max(int(columns[0]) - margin, 0), min(int(columns[-1]) + margin, mask.shape[1])
    reduction = min(1.0, PERSON_HEIGHT_PX / person)
    extent_px = right - left, bottom - top
    size = max(1, round(extent_px[0] * reduction)), max(1, round(extent_px[1] * reduction))
    scale = np.array(size) / extent_px
    small = cv2.resize(mask[top:bottom, left:right], size, interpolation=cv2.INTER_AREA) > 127
    distance = signed_distance(small)
    return MaskWindow(
        left, top, scale, small, distance, outward_normals(distance), outline_pixels(small), person * reduction
    )


def signed_distance(inside: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Return the distance to the outline between pixel centres (px): positive outside, -0.5 in boundary pixels."""
    return np.where(inside, 0.5 - distance_px(inside), distance_px(~inside) - 0.5).astype(np.float32)


def distance_px(area: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Return the Euclidean distance in pixels from every pixel inside to the nearest pixel outside; 0 outside.

    Runs without Intel IPP, which OpenCV uses for small images or a single thread: IPP rounds differently if its output
    is not aligned to 32 bytes, and malloc aligns to 16.
    """
    with_ipp = cv2.ipp.useIPP()
    cv2.ipp.setUseIPP(False)
    try:
        return cv2.distanceTransform(area.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    finally:
        cv2.ipp.setUseIPP(with_ipp)


def outline_pixels(inside: Bool[np.ndarray, "h w"]) -> Int[np.ndarray, "q 2"]:
    """Return (row, column) of the inside pixels with an outside neighbour; the image border is no outline."""
    padded = np.pad(inside, 1, mode="edge")
    surrounded = padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
    return np.argwhere(inside & ~surrounded)


def outward_normals(distance: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w 2"]:
    """Return the smoothed unit gradient (x, y) of a signed distance."""
    smooth = cv2.GaussianBlur(distance, (0, 0), 1.5)
    across, down = cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)
    # cv2.magnitude uses Intel IPP, whose rounding depends on the memory alignment of its output.
    length = np.maximum(np.sqrt(across * across + down * down), 1e-6)
    return np.stack([across / length, down / length], axis=-1)


@dataclass(frozen=True)
class PosedBody:
    """The body in every frame, skinned on demand.

    weighted_vertices: w_j (x, y, z, 1) of all joints j (q = 4 j), w the skin weights: skinning is one matrix product.
    transforms: of the joints in every frame, in the same order, transposed.
    """

    weighted_vertices: Float[Tensor, "v q"]
    transforms: Float[Tensor, "n q 3"]

    def vertices(self, rows: slice) -> Float[Tensor, "k v 3"]:
        """Return the world vertices (m, float32) in some frames."""
        return self.weighted_vertices @ self.transforms[rows]


def posed_body(model: LinearBody, state: FitState) -> PosedBody:
    """Return the body of a state."""
    posed = model.at_shape(state.shape)
    skeleton = pose_skeleton(posed, state.rotations, state.root_m)
    rotated_joints_m = (skeleton.rotation @ posed.joints_m[:, :, None]).squeeze(-1)
    transforms = rigid_transform(skeleton.rotation, skeleton.position_m - rotated_joints_m).float()
    vertices = torch.nn.functional.pad(posed.vertices_m, (0, 1), value=1.0)
    weighted = (posed.skin_weights[:, :, None] * vertices[:, None]).flatten(1)
    return PosedBody(weighted.float(), transforms[:, :, :3].transpose(2, 3).flatten(1, 2).contiguous())


def posed_vertices(model: LinearBody, state: FitState) -> Float[Tensor, "n v 3"]:
    """Return the world vertices (m, float32) of the body in every frame."""
    return posed_body(model, state).vertices(slice(None))


@dataclass(frozen=True)
class BodyRaster:
    """The body rasterised in a window: face of each pixel (-1: none) and barycentric coordinates."""

    face_id: Int[np.ndarray, "h w"]
    barycentric: Float[np.ndarray, "h w 3"]


def rasterise_in_window(
    vertices_world: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"], camera: Camera, window: MaskWindow
) -> BodyRaster:
    """Rasterise a posed body in the pixels of a window.

    vertices_world: metres.
    """
    vertices_px, depth_m = project(vertices_world, camera)
    corner, scale = vertices_px.new_tensor([window.left_px, window.top_px]), vertices_px.new_tensor(window.scale_xy)
    height, width = window.mask.shape
    face_id, barycentric, _ = rasterize((vertices_px - corner) * scale, depth_m, faces, height, width)
    return BodyRaster(face_id.numpy(), barycentric.numpy())


@dataclass(frozen=True)
class Correspondences:
    """Pairs of one frame, in window pixels (x, y); `pixel` is (row, column)."""

    pixel: Int[np.ndarray, "m 2"]
    target: Float[np.ndarray, "m 2"]
    normal: Float[np.ndarray, "m 2"]
    weight: Float[np.ndarray, "m"]


def find_correspondences(
    window: MaskWindow, body_mask: Bool[np.ndarray, "h w"], is_head_or_foot: Bool[np.ndarray, "h w"]
) -> Correspondences:
    """Match the outline of the rasterised body with that of the mask, in both directions (module docstring).

    is_head_or_foot: pixels of the head and the feet of the body.
    """
    body_outline = outline_pixels(body_mask)
    if len(body_outline) == 0 or len(window.outline) == 0:
        empty = np.zeros((0, 2))
        return Correspondences(empty.astype(np.int64), empty, empty, np.zeros(0))
    mask_normal, body_normal = window.normal, outward_normals(signed_distance(body_mask))
    max_distance = MAX_PAIR_DISTANCE_RATIO * window.person_px
    from_body = _subsample(body_outline)
    normal = mask_normal[from_body[:, 0], from_body[:, 1]]
    gap = window.distance[from_body[:, 0], from_body[:, 1]] + 0.5
    agree = (normal * body_normal[from_body[:, 0], from_body[:, 1]]).sum(1) > 0.3
    is_bulky = is_head_or_foot[from_body[:, 0], from_body[:, 1]]
    first = Correspondences(
        from_body,
        from_body[:, ::-1] + 0.5 - gap[:, None] * normal,
        normal,
        ((np.abs(gap) < max_distance) & agree) * _clothing_weights(gap, is_bulky),
    )
    from_mask = _subsample(window.outline)
    distance_px, nearest = cKDTree(body_outline).query(from_mask)
    partner = body_outline[nearest]
    normal = mask_normal[from_mask[:, 0], from_mask[:, 1]]
    gap = ((partner - from_mask)[:, ::-1] * normal).sum(1)
    agree = (normal * body_normal[partner[:, 0], partner[:, 1]]).sum(1) > 0.3
    is_bulky = is_head_or_foot[partner[:, 0], partner[:, 1]]
    second = Correspondences(
        partner,
        from_mask[:, ::-1] + 0.5,
        normal,
        ((distance_px < max_distance) & agree) * _clothing_weights(gap, is_bulky),
    )
    return Correspondences(
        *(np.concatenate(pair) for pair in zip(vars(first).values(), vars(second).values(), strict=True))
    )


def _clothing_weights(gap: Float[np.ndarray, "m"], is_head_or_foot: Bool[np.ndarray, "m"]) -> Float[np.ndarray, "m"]:
    """Return the weights of pairs; smaller where the mask is outside the body (gap < 0)."""
    return np.where(gap < 0, np.where(is_head_or_foot, HAIR_AND_SHOES_WEIGHT, CLOTHING_WEIGHT), 1.0)


def _subsample(pixels: Int[np.ndarray, "q 2"]) -> Int[np.ndarray, "m 2"]:
    """Return about `PAIRS_PER_DIRECTION` pixels of an outline, evenly spaced in scan order."""
    return pixels[np.linspace(0, len(pixels) - 1, min(PAIRS_PER_DIRECTION, len(pixels))).astype(np.int64)]


def mask_weights(silhouette_iou: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Return the weight of each frame's pairs (0 to 1): small if its IoU is far below the median.

    Frames without a mask (nan) have weight 1; they have no pairs.
    """
    if np.isnan(silhouette_iou).all():
        return np.ones_like(silhouette_iou)
    iou_drop = np.nanmedian(silhouette_iou) - silhouette_iou
    return np.nan_to_num(
        np.clip((MIN_WEIGHT_IOU_DROP - iou_drop) / (MIN_WEIGHT_IOU_DROP - FULL_WEIGHT_IOU_DROP), MIN_MASK_WEIGHT, 1.0),
        nan=1.0,
    )


def skirt_faces(model: LinearBody, state: FitState, hem: float) -> Bool[np.ndarray, "f"]:
    """Return the faces of hips and legs that a skirt hides, between `SKIRT_TOP` and its hem in the canonical pose."""
    posed = model.at_shape(state.shape)
    hips_m, knees_m = (
        posed.joints_m[[ACTIVE_JOINTS.index(side + name) for side in ("Left", "Right")], 1].mean()
        for name in ("UpLeg", "Leg")
    )
    height = (posed.vertices_m[:, 1] - hips_m) / (knees_m - hips_m)
    is_hidden = (model.skin_weight_of(SKIRT_JOINTS) > 0.5) & (height > SKIRT_TOP) & (height < hem)
    return np.asarray(is_hidden[model.faces[:, 0].long()].numpy())


def match_silhouettes(
    model: LinearBody,
    state: FitState,
    observations: Observations,
    windows: Sequence[MaskWindow | None],
    hem: float | None = None,
) -> tuple[Contour, Float[np.ndarray, "n"]]:
    """Return the silhouette pairs of the current body, and each frame's IoU with its mask (nan without a mask).

    windows: masks of the frames (`crop_mask_window`); None without a mask. hem: of a skirt, see `FitOptions`: what it
    hides has no pairs, unless it is beside the mask.
    """
    camera = apply_intrinsics_delta(observations.camera, state.intrinsics_delta)
    posed = posed_body(model, state)
    head_and_foot_faces = (model.skin_weight_of(HEAD_AND_FOOT_JOINTS) > 0.5)[model.faces[:, 0].long()].numpy()
    hidden_faces = np.zeros(len(model.faces), dtype=bool) if hem is None else skirt_faces(model, state, hem)
    face_joint = model.skin_weights.argmax(1)[model.faces[:, 0].long()]
    joint_weight = outline_weights(observations.confidence)
    size = 2 * PAIRS_PER_DIRECTION
    frames = len(windows)
    corners = torch.zeros(frames, size, 3, dtype=torch.int64)
    barycentric, target = torch.zeros(frames, size, 3).double(), torch.zeros(frames, size, 2).double()
    normal, weight = torch.zeros(frames, size, 2).double(), torch.zeros(frames, size).double()
    silhouette_iou = np.full(frames, np.nan)

    def match(frame: int, vertices: Float[Tensor, "v 3"], window: MaskWindow) -> None:
        body_raster = rasterise_in_window(vertices, model.faces, camera, window)
        body_mask = body_raster.face_id >= 0
        silhouette_iou[frame] = mask_iou(body_mask, window.mask)
        pairs = find_correspondences(window, body_mask, body_mask & head_and_foot_faces[body_raster.face_id])
        count, (rows, columns) = len(pairs.weight), pairs.pixel.T
        face = torch.from_numpy(body_raster.face_id[rows, columns])
        pair_weight = pairs.weight * ~(hidden_faces[face] & window.mask[rows, columns])
        corners[frame, :count] = model.faces[face].long()
        barycentric[frame, :count] = torch.from_numpy(body_raster.barycentric[rows, columns]).double()
        target[frame, :count] = torch.from_numpy(pairs.target / window.scale_xy + [window.left_px, window.top_px])
        normal[frame, :count] = torch.from_numpy(pairs.normal).double()
        shown = joint_weight[frame, face_joint[face]]
        weight[frame, :count] = torch.from_numpy(pair_weight * (FRAME_WEIGHT / max((pair_weight > 0).sum(), 1))) * shown

    def match_chunk(start: int) -> None:
        chunk = windows[start : start + SKIN_CHUNK]
        for row, (vertices, window) in enumerate(
            zip(posed.vertices(slice(start, start + len(chunk))), chunk, strict=True)
        ):
            if window is not None:
                match(start + row, vertices, window)

    shared_thread_pool(torch.get_num_threads()).map(match_chunk, range(0, frames, SKIN_CHUNK))
    weight *= torch.from_numpy(mask_weights(silhouette_iou))[:, None]
    return Contour(corners, barycentric, target, normal, weight), silhouette_iou
