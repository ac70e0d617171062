"""Fingers of a given width: the surface is scaled about the bones of each finger."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from pipeline.body.body import Body

FINGERS = ("Thumb", "Index", "Middle", "Ring", "Pinky")
SEGMENTS = 3
"""Joints of a finger; the last bone ends at the tip."""

FULL_WEIGHT = 0.5
"""Skin weight on the joints of a finger from which a vertex belongs to it; below, the scale fades into the hand."""


def with_finger_width(body: Body, width_m: float) -> Body:
    """Return the body with all fingers and thumbs of this mean width (twice the mean distance from their bones)."""
    vertices = body.vertices.astype(np.float64)
    for side in ("Left", "Right"):
        for finger in FINGERS:
            joints = [body.joint(f"{side}Hand{finger}{number + 1}") for number in range(SEGMENTS)]
            weight = body.skin_weights[:, joints].sum(axis=1)
            share = np.clip(weight / FULL_WEIGHT, 0.0, 1.0)
            rows = np.flatnonzero(share > 0.0)
            axis_m = nearest_on_polyline(vertices[rows], _bones_m(body, joints, vertices[weight > FULL_WEIGHT]))
            offset_m = vertices[rows] - axis_m
            width_now_m = 2.0 * np.linalg.norm(offset_m[share[rows] == 1.0], axis=1).mean()
            scale = 1.0 + share[rows, None] * (width_m / width_now_m - 1.0)
            vertices[rows] = axis_m + scale * offset_m
    return replace(body, vertices=vertices.astype(body.vertices.dtype))


def _bones_m(body: Body, joints: list[int], finger_m: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "4 3"]:
    """Return the joints of a finger and its tip: as far along the last bone as its vertices reach."""
    positions = body.joints_m[joints].astype(np.float64)
    ahead = positions[-1] - positions[-2]
    ahead /= np.linalg.norm(ahead)
    reach_m = float(((finger_m - positions[-1]) @ ahead).max())
    return np.concatenate([positions, [positions[-1] + reach_m * ahead]])


def nearest_on_polyline(points: Float[np.ndarray, "n 3"], line: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "n 3"]:
    """Return the point of a polyline that is nearest to each point."""
    start, step = line[:-1], np.diff(line, axis=0)
    along = np.einsum("nsk,sk->ns", points[:, None] - start, step) / (step**2).sum(axis=1)
    candidates = start + np.clip(along, 0.0, 1.0)[..., None] * step
    best = np.linalg.norm(candidates - points[:, None], axis=2).argmin(axis=1)
    return candidates[np.arange(len(points)), best]
