"""Detection of foreign objects in the masks: a ball, a bag, a caption. They are reported; the user decides."""

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pipeline.body.body import Body
from pipeline.body.filmed_legs import rows_on_legs
from pipeline.body.fit.silhouette_icp import SKIRT_TOP, MaskWindow, distance_px, rasterise_in_window
from pipeline.body.overlay import pose_vertices
from pipeline.capture.frame_selection import format_frame_ranges
from pipeline.geometry.camera import Camera

CLOTHING_MARGIN_RATIO = 0.03
"""Expected distance of the mask outline from the body, over the height of the person in the image."""

MIN_EXCESS_BLOB_SHARE = 0.01
"""A frame is reported if its largest residual blob exceeds the median by this fraction of the mask, about a foot.

Maxima without foreign objects: turn 0.0004, self-capture 0.0035, hem of a skirt 0.008. A juggled ball: 0.015 to 0.074;
a caption connected to a foot: 0.012.
"""


def residual_blob_share(
    mask: Bool[np.ndarray, "h w"],
    body_mask: Bool[np.ndarray, "h w"],
    person_px: float,
    rows_of_skirt: slice = slice(0),
) -> float:
    """Return the fraction (0 to 1) of the mask in its largest connected part beyond the clothing margin.

    person_px: height of the person. rows_of_skirt: those in which all of the mask may be cloth.
    """
    beyond = mask & (distance_px(~body_mask) > CLOTHING_MARGIN_RATIO * person_px)
    beyond[rows_of_skirt] = False
    _, _, parts, _ = cv2.connectedComponentsWithStats(beyond.astype(np.uint8))
    return float(parts[1:, cv2.CC_STAT_AREA].max(initial=0)) / max(1, int(mask.sum()))


def residual_blob_shares(
    body: Body,
    canonical_to_world: Float[Tensor, "n j 4 4"],
    camera: Camera,
    windows: Sequence[MaskWindow | None],
    hem: float | None = None,
) -> Float[np.ndarray, "n"]:
    """Return `residual_blob_share` of every frame; nan where the mask is empty.

    windows: of the masks, from `crop_mask_window`. hem: of a skirt that stands off the legs, as of
    `Body.height_on_legs_m`; None without one.
    """
    faces = torch.as_tensor(body.faces)
    shares = np.full(len(windows), np.nan)
    for frame, window in enumerate(windows):
        if window is not None:
            pose, rows = canonical_to_world[frame], slice(0)
            body_raster = rasterise_in_window(pose_vertices(body, pose), faces, camera, window)
            if hem is not None:
                top, bottom = rows_on_legs((SKIRT_TOP, hem), body, pose, camera, window)
                rows = slice(max(top, 0), max(bottom, 0))
            shares[frame] = residual_blob_share(window.mask, body_raster.face_id >= 0, window.person_px, rows)
    return shares


def frames_with_foreign_objects(shares: Float[np.ndarray, "n"]) -> Bool[np.ndarray, "n"]:
    """Return the frames whose residual blob is much larger than the median: wide clothes appear in all frames."""
    return (
        np.nan_to_num(shares)
        > np.nan_to_num(np.nanmedian(shares) if np.isfinite(shares).any() else 0.0) + MIN_EXCESS_BLOB_SHARE
    )


def foreign_object_warnings(shares: Float[np.ndarray, "n"], frame_index: Int[np.ndarray, "n"]) -> list[str]:
    """Return a warning about the frames of `frames_with_foreign_objects`; empty if there are none."""
    has_foreign_object = frames_with_foreign_objects(shares)
    if not has_foreign_object.any():
        return []
    return [
        f"frames {format_frame_ranges(frame_index, has_foreign_object)}: the mask contains another object (a ball, a "
        "bag, a caption?), or the pose is wrong; exclude these frames with split.json, or supply masks/"
    ]
