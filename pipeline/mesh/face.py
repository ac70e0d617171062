"""Where a surface is the skin of a person's head, whose shape is the body model's, and where it is hair.

The colours of a face (brows, beard, glasses) look like dents and bumps to the density, and its shape is much alike from
person to person. Hair, hats and collars have no counterpart in the body model: they are where the surface lies far off
its head. Mouth, nose and eyes count as skin at any distance.
"""

import numpy as np
from jaxtyping import Bool, Float

from pipeline.body.body import Body

SKIN_OFFSET_M, HAIR_OFFSET_M = 0.008, 0.02
"""Up to the first distance from the body model's head a surface is skin, from the second on it is hair."""
BROW_HEIGHT, FEATURE_HALF_WIDTH = 0.62, 0.6
"""The brows, as a share of the height of the head over its lowest point; the features (eyes, nose, mouth), as a share
of half its width with the ears."""
EAR_HALF_WIDTH, EAR_HEIGHTS = 0.78, (0.25, 0.75)
"""Ears: farther from the middle than this share of half the width of the head with the ears, between these heights, as
shares of that of the head."""
EDGE_M = 0.01
"""Width of the transition at the edges of the face and of its features."""


def head_vertices(body: Body) -> Bool[np.ndarray, "v"]:
    """Return which body vertices belong to the head; none if the body has no joint of this name."""
    if "Head" not in body.joint_names:
        return np.zeros(len(body.vertices), dtype=bool)
    return body.skin_weights[:, body.joint("Head")] > 0.5


def head_skin_weight(
    points_m: Float[np.ndarray, "n 3"], offset_m: Float[np.ndarray, "n"], body: Body
) -> Float[np.ndarray, "n"]:
    """Return the weight in [0, 1] of skin, against hair, at points on and around a surface at the head.

    Args:
        points_m: points of the canonical space, m.
        offset_m: distance of the surface at these points from the body, positive outside, m.
        body: the fitted body in its canonical pose; without a head joint all weights are 0.
    """
    head = body.vertices[head_vertices(body)]
    if len(head) == 0:
        return np.zeros(len(points_m))
    low_m, high_m = head.min(axis=0), head.max(axis=0)
    close = 1.0 - smooth_step((offset_m - SKIN_OFFSET_M) / (HAIR_OFFSET_M - SKIN_OFFSET_M))
    return np.maximum(close, _features(points_m, low_m, high_m)) * smooth_step((points_m[:, 1] - low_m[1]) / EDGE_M)


def face_weight(
    points_m: Float[np.ndarray, "n 3"], offset_m: Float[np.ndarray, "n"], body: Body
) -> Float[np.ndarray, "n"]:
    """Return the weight in [0, 1] of the face: `head_skin_weight` in the front half of the head, else 0."""
    head = body.vertices[head_vertices(body)]
    if len(head) == 0:
        return np.zeros(len(points_m))
    middle_m = 0.5 * (head[:, 2].min() + head[:, 2].max())
    return head_skin_weight(points_m, offset_m, body) * smooth_step((points_m[:, 2] - middle_m) / EDGE_M)


def is_ear(points_m: Float[np.ndarray, "n 3"], body: Body) -> Bool[np.ndarray, "n"]:
    """Return which points of the canonical space (m) are as far out as the ears of the body, at their height."""
    head = body.vertices[head_vertices(body)]
    if len(head) == 0:
        return np.zeros(len(points_m), dtype=bool)
    low_m, high_m = head.min(axis=0), head.max(axis=0)
    middle_m, half_width_m = 0.5 * (low_m + high_m), 0.5 * (high_m[0] - low_m[0])
    height = (points_m[:, 1] - low_m[1]) / (high_m[1] - low_m[1])
    is_outside = np.abs(points_m[:, 0] - middle_m[0]) > EAR_HALF_WIDTH * half_width_m
    return np.asarray(is_outside & (height > EAR_HEIGHTS[0]) & (height < EAR_HEIGHTS[1]))


def _features(
    points_m: Float[np.ndarray, "n 3"], low_m: Float[np.ndarray, "3"], high_m: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "n"]:
    """Return the weight of mouth, nose and eyes: in front, below the brows, between the temples."""
    middle_m, half_width_m = 0.5 * (low_m + high_m), 0.5 * (high_m[0] - low_m[0])
    brow_m = low_m[1] + BROW_HEIGHT * (high_m[1] - low_m[1])
    margins_m = (
        brow_m - points_m[:, 1],
        FEATURE_HALF_WIDTH * half_width_m - np.abs(points_m[:, 0] - middle_m[0]),
        points_m[:, 2] - middle_m[2],
    )
    return np.prod([smooth_step(margin_m / EDGE_M + 0.5) for margin_m in margins_m], axis=0)


def smooth_step(values: Float[np.ndarray, "n"], low: float = 0.0, high: float = 1.0) -> Float[np.ndarray, "n"]:
    """Return 0 up to `low`, 1 from `high` on, and a cubic with level ends between."""
    clipped = np.clip((values - low) / (high - low), 0.0, 1.0)
    return np.asarray(clipped * clipped * (3.0 - 2.0 * clipped))
