"""The space between the legs, where frames show little: strands and ridges are cleared, valleys are closed.

Grids are samples of canonical space: origin_m is the position of sample [0, 0, 0], spacing_m the distance of
neighbours; body_distance_m is the signed distance to the fitted body, negative inside.
"""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

MAX_STRAND_AREA_M2 = 0.002
"""Horizontal cross-section up to which a piece between the legs that holds no leg is a strand, m²: 4.5 cm squared. That
of a skirt is a ring, and larger."""
MIN_INNER_OFFSET_M, OUTER_OFFSET_PERCENTILE = 0.015, 90.0
"""Trousers may lie this far from the inner side of a leg, or as far as this percentile from its outer side."""
MIN_RIDGE_M = 0.015
"""A ridge goes farther beyond by this distance at least: legs are not fitted exactly in the middle of trousers."""
VALLEY_RADIUS_M, VALLEY_SIGMA_M = 0.03, 0.012
"""Valleys at the crotch that a disc of this radius cannot enter are closed, and what closes them is smoothed."""
VALLEY_RISE_M = 0.02
"""Height over the lowest slice that joins the legs from which on a valley is closed altogether."""
MIN_JOINED_M, MAX_JOINED_M = 0.03, 0.15
"""Legs that are joined over less than the first height below the crotch of the body have no valley; cloth that joins
them over more than the second is a skirt."""
VALLEY_HALF_WIDTH_M, VALLEY_HEIGHT_M, VALLEY_FADE_M = 0.05, 0.04, 0.04
"""Valleys are this far from the middle at most, and up to this height above the crotch of the body; beyond, the change
fades over a distance."""


def _middle_and_crotch(
    body: Bool[np.ndarray, "x y z"], origin_m: Float[np.ndarray, "3"], spacing_m: float
) -> tuple[int, int]:
    """Return the column of x = 0, and the lowest row in which the body is in it; 0 without a body there."""
    middle = round(-origin_m[0] / spacing_m)
    if not 0 < middle < len(body):
        return 0, 0
    return middle, int(np.argmax(body[middle].any(axis=1)))


def excess_between_legs(
    inside: Bool[np.ndarray, "x y z"],
    body_distance_m: Float[np.ndarray, "x y z"],
    origin_m: Float[np.ndarray, "3"],
    spacing_m: float,
) -> Bool[np.ndarray, "x y z"]:
    """Return the parts of the solid between the legs that are no trousers: strands and ridges.

    Where trousers touch each other, nothing shows the valley between them, and it is filled; the canonical pose, whose
    legs are apart, cuts the filling into a ridge on either leg and strands between them. In each horizontal slice below
    the crotch, a piece that holds no leg and is no larger than `MAX_STRAND_AREA_M2` is a strand, and a piece that holds
    one leg alone ends on its inner side as near to the body as on its outer side. A piece that holds both legs is a
    skirt or coat, and stays.
    """
    excess = np.zeros_like(inside)
    body = body_distance_m < 0.0
    middle, crotch = _middle_and_crotch(body, origin_m, spacing_m)
    for row in range(crotch):
        legs = [np.flatnonzero(body[part, row].any(axis=1)) for part in (np.s_[:middle], np.s_[middle:])]
        if all(len(leg) > 0 for leg in legs):
            axes = (float(legs[0].mean()), float(legs[1].mean()) + middle)
            excess[:, row] = _excess_in_slice(inside[:, row], body_distance_m[:, row], axes, spacing_m)
    return excess


def _excess_in_slice(
    inside: Bool[np.ndarray, "x z"],
    body_distance_m: Float[np.ndarray, "x z"],
    axes: tuple[float, float],
    spacing_m: float,
) -> Bool[np.ndarray, "x z"]:
    """Return the samples of a slice to be cleared. axes: columns of the axes of the two legs."""
    column = np.arange(len(inside))[:, None]
    between = (column > axes[0]) & (column < axes[1])
    labels, count = ndimage.label(inside, np.ones((3, 3), dtype=int))
    is_leg = body_distance_m < 0.0
    of_leg = [np.unique(labels[is_leg & (labels > 0) & side]) for side in (column <= axes[0], column >= axes[1])]
    holds_leg = np.zeros(count + 1, dtype=bool)
    holds_leg[labels[is_leg]] = True
    is_small = np.bincount(labels.ravel(), minlength=count + 1) * spacing_m**2 <= MAX_STRAND_AREA_M2
    excess = inside & between & (is_small & ~holds_leg)[labels]
    if np.intersect1d(*of_leg).size:
        return excess
    for own, outer in zip(of_leg, (column <= axes[0], column >= axes[1]), strict=True):
        piece = np.isin(labels, own)
        outline = piece & ~ndimage.binary_erosion(piece) & outer
        if outline.any():
            offset_m = max(np.percentile(body_distance_m[outline], OUTER_OFFSET_PERCENTILE), MIN_INNER_OFFSET_M)
            beyond = piece & between & (body_distance_m > offset_m)
            if (body_distance_m[beyond] > offset_m + MIN_RIDGE_M).any():
                excess |= beyond
    return excess


def close_valleys(
    distance_m: Float[np.ndarray, "x y z"],
    body_distance_m: Float[np.ndarray, "x y z"],
    origin_m: Float[np.ndarray, "3"],
    spacing_m: float,
) -> Float[np.ndarray, "x y z"]:
    """Return a signed distance without the valleys in front of and behind the crotch.

    Cloth hangs from leg to leg there, and few frames show what is behind it. Each horizontal slice in which the solid
    joins both legs is closed by a disc, which does not change the outline from in front, and thighs hide it from the
    side; then all is smoothed. The slices below, in which the legs are apart, stay.

    distance_m: of the solid, negative inside.
    """
    middle, crotch = _middle_and_crotch(body_distance_m < 0.0, origin_m, spacing_m)
    is_apart = (distance_m[middle] >= 0.0).all(axis=1)[:crotch]
    lowest = int(np.flatnonzero(is_apart)[-1]) + 1 if is_apart.any() else 0
    joined_m = spacing_m * (crotch - lowest)
    if not MIN_JOINED_M < joined_m < MAX_JOINED_M:
        return distance_m
    across_m = spacing_m * np.abs(np.arange(len(distance_m)) - middle)
    up_m = spacing_m * np.arange(distance_m.shape[1])
    rise = np.clip((up_m - spacing_m * lowest) / VALLEY_RISE_M, 0.0, 1.0)
    height = rise * _fade(up_m - spacing_m * crotch - VALLEY_HEIGHT_M)
    share = _fade(across_m - VALLEY_HALF_WIDTH_M)[:, None] * height
    share *= min(1.0, (joined_m - MIN_JOINED_M) / VALLEY_FADE_M)
    reach = round(VALLEY_RADIUS_M / spacing_m)
    columns, rows = (_padded_span(used, 2 * reach) for used in np.nonzero(share))
    square = np.arange(-reach, reach + 1) ** 2
    disc = square[:, None] + square <= reach**2
    part_m = distance_m[columns, rows]
    filled_m = part_m.copy()
    for row in range(lowest - rows.start, part_m.shape[1]):
        filled_m[:, row] = ndimage.grey_opening(part_m[:, row], footprint=disc)
    smooth_m = ndimage.gaussian_filter(filled_m, VALLEY_SIGMA_M / spacing_m)
    closed_m = distance_m.copy()
    closed_m[columns, rows] += share[columns, rows, None] * (smooth_m - part_m)
    return closed_m


def _fade(beyond_m: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Return 1 within a limit, and less and less up to `VALLEY_FADE_M` beyond it."""
    return np.clip(1.0 - beyond_m / VALLEY_FADE_M, 0.0, 1.0)


def _padded_span(indices: Int[np.ndarray, "n"], padding: int) -> slice:
    """Return the slice of the indices with as many more on both sides."""
    return slice(max(0, int(indices.min()) - padding), int(indices.max()) + padding + 1)
