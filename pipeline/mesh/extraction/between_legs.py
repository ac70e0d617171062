"""The space between the legs, where frames show little: strands and ridges are cleared, valleys are closed.

A skirt or coat is one piece down to its hem; below it the legs are parted.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from pipeline.body.body import Body

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
LEGS = (("LeftUpLeg", "LeftLeg"), ("RightUpLeg", "RightLeg"))
"""Joints of hip and knee."""
CROTCH_SHARE = 0.25
"""Distance of the crotch below the hip joints, as a share of the thigh; 0.23 to 0.28 in three fitted bodies."""
SKIRT_RADIUS_M = 0.06
"""Gaps in a skirt that a horizontal disc, or a ball, of this radius cannot enter are closed. Where a gap parts the
legs, the disc is as wide as the space between them."""
HEM_RANGE_M = 0.05
"""The hem of the surface is up to this distance from the height that the masks tell."""
HEM_ERROR_M = 0.02
"""A gap that parts the legs is closed from this height above the hem on."""
SKIRT_ABOVE_CROTCH_M = 0.2
"""A skirt or coat is closed up to this height above the crotch."""
PARTING_M = 0.01
"""Width of the gap that parts the legs below a hem; two samples at least."""
MIN_JOINED_M, MAX_JOINED_M = 0.03, 0.15
"""Legs that are joined over less than the first height below the crotch of the body have no valley, nor have those
that are joined over more than the second."""
VALLEY_HALF_WIDTH_M, VALLEY_HEIGHT_M, VALLEY_FADE_M = 0.05, 0.04, 0.04
"""Valleys are this far from the middle at most, and up to this height above the crotch of the body; beyond, the change
fades over a distance."""


@dataclass(frozen=True)
class LegGrid:
    """The fitted body on a grid of samples of canonical space.

    origin_m: position of sample [0, 0, 0]. spacing_m: distance of neighbours. body_distance_m: signed distance to the
    body, negative inside. crotch_m: height of its crotch, from `crotch_height_m`. hem_m: height of the hem of a
    skirt or coat; None without one.
    """

    origin_m: Float[np.ndarray, "3"]
    spacing_m: float
    body_distance_m: Float[np.ndarray, "x y z"]
    crotch_m: float
    hem_m: float | None

    def middle(self) -> int:
        """Return the column of x = 0; 0 where the grid has not both legs."""
        middle = round(-self.origin_m[0] / self.spacing_m)
        return middle if 0 < middle < self.body_distance_m.shape[0] else 0

    def legs_top_m(self) -> float:
        """Return the height below which the legs are apart: the crotch, or a lower hem."""
        return self.crotch_m if self.hem_m is None else min(self.crotch_m, self.hem_m)

    def row(self, height_m: float) -> int:
        """Return the row at a height, within the grid."""
        row = round((height_m - self.origin_m[1]) / self.spacing_m)
        return min(max(row, 0), self.body_distance_m.shape[1])


def crotch_height_m(body: Body) -> float:
    """Return the height (y, canonical) of the crotch, m; that of the lowest vertex for a body without legs.

    It follows from the joints, because thighs that were filmed side by side touch each other farther down.
    """
    if not {joint for leg in LEGS for joint in leg} <= set(body.joint_names):
        return float(body.vertices[:, 1].min())
    return body.height_on_legs_m(CROTCH_SHARE)


def _leg_axes(is_leg: Bool[np.ndarray, "x z"], middle: int) -> tuple[float, float] | None:
    """Return the columns of the axes of the two legs in a slice; None where it has not both."""
    legs = [np.flatnonzero(part.any(axis=1)) for part in (is_leg[:middle], is_leg[middle:])]
    return (float(legs[0].mean()), float(legs[1].mean()) + middle) if all(len(leg) for leg in legs) else None


def excess_between_legs(inside: Bool[np.ndarray, "x y z"], grid: LegGrid) -> Bool[np.ndarray, "x y z"]:
    """Return the parts of the solid between the legs that are no trousers: strands and ridges.

    Where trousers touch each other, nothing shows the valley between them, and it is filled; the canonical pose, whose
    legs are apart, cuts the filling into a ridge on either leg and strands between them. In each horizontal slice below
    the crotch, and the hem, a piece that holds no leg and is no larger than `MAX_STRAND_AREA_M2` is a strand, and a
    piece that holds one leg alone ends on its inner side as near to the body as on its outer side. A piece that holds
    both legs stays.
    """
    excess, middle = np.zeros_like(inside), grid.middle()
    top_m = grid.legs_top_m()
    for row in range(grid.row(top_m) if middle else 0):
        distance_m = grid.body_distance_m[:, row]
        axes = _leg_axes(distance_m < 0.0, middle)
        if axes is not None:
            excess[:, row] = _excess_in_slice(inside[:, row], distance_m, axes, grid.spacing_m)
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


def gaps_in_skirt(inside: Bool[np.ndarray, "x y z"], grid: LegGrid) -> Bool[np.ndarray, "x y z"]:
    """Return holes and notches of a skirt or coat above its hem, and gaps that part it; none without a hem.

    Frames hardly show its depth between the legs, where it is far from the body. In each horizontal slice up to
    `SKIRT_ABOVE_CROTCH_M` above the crotch, the pieces that hold the legs are closed by a disc; then all slices
    together by a ball.
    """
    gaps, middle = np.zeros_like(inside), grid.middle()
    if grid.hem_m is None or not middle:
        return gaps
    bottom, top = grid.row(grid.hem_m), grid.row(grid.crotch_m + SKIRT_ABOVE_CROTCH_M)
    parted_from, closed = grid.row(grid.hem_m + HEM_ERROR_M), np.zeros_like(inside[:, bottom:top])
    for row in range(bottom, top):
        labels, _ = ndimage.label(inside[:, row], np.ones((3, 3), dtype=int))
        is_leg = grid.body_distance_m[:, row] < 0.0
        legs = np.where(is_leg, labels, 0)
        held, radius_m = np.intersect1d(legs[:middle], legs[middle:]), SKIRT_RADIUS_M
        if not held.any():
            if row < parted_from:
                continue
            held, radius_m = np.unique(legs), max(radius_m, grid.spacing_m * _columns_between(is_leg, middle))
        closed[:, row - bottom] = closing(np.isin(labels, held[held > 0]), radius_m, grid.spacing_m)
    # Nothing is below the hem; above the top the cloth goes on.
    reach = int(np.ceil(SKIRT_RADIUS_M / grid.spacing_m)) + 1
    going_on = np.pad(closed, ((0, 0), (0, reach), (0, 0)), mode="edge")
    closed = closing(going_on, SKIRT_RADIUS_M, grid.spacing_m)[:, : closed.shape[1]]
    gaps[:, bottom:top] = closed & ~inside[:, bottom:top]
    return gaps


def _columns_between(is_leg: Bool[np.ndarray, "x z"], middle: int) -> int:
    """Return how many columns are between the two legs in a slice; 0 where it has not both."""
    columns = np.flatnonzero(is_leg.any(axis=1))
    left, right = columns[columns >= middle], columns[columns < middle]
    return int(left.min() - right.max()) if len(left) and len(right) else 0


def closing(solid: Bool[np.ndarray, "*n"], radius_m: float, spacing_m: float) -> Bool[np.ndarray, "*n"]:
    """Return the morphological closing by a disc or ball."""
    padding = int(np.ceil(radius_m / spacing_m)) + 1
    outside_m = spacing_m * ndimage.distance_transform_edt(~np.pad(solid, padding))
    closed = spacing_m * ndimage.distance_transform_edt(outside_m <= radius_m) > radius_m
    return closed[(np.s_[padding:-padding],) * solid.ndim]


def parted_legs(grid: LegGrid) -> Float[np.ndarray, "x y z"]:
    """Return an indicator that falls from 1 to 0 in the middle between the legs below a hem; 1 elsewhere.

    Trousers that touch each other below a coat would grow together in its canonical pose, whose legs are the filmed
    ones. It is 0.5 at `PARTING_M` from side to side.
    """
    indicator = np.ones(grid.body_distance_m.shape, dtype=np.float32)
    if grid.hem_m is None:
        return indicator
    middle, width_m = grid.middle(), max(PARTING_M, 2.0 * grid.spacing_m)
    for row in range(grid.row(grid.hem_m)):
        is_leg = grid.body_distance_m[:, row] < 0.0
        if is_leg[:middle].any() and is_leg[middle:].any():
            left = np.arange(len(is_leg))[:, None] >= middle
            apart_m = np.subtract(*(ndimage.distance_transform_edt(~(is_leg & side)) for side in (left, ~left)))
            indicator[:, row] = np.minimum(np.abs(apart_m) * grid.spacing_m / (2.0 * width_m), 1.0)
    return indicator


def close_valleys(distance_m: Float[np.ndarray, "x y z"], grid: LegGrid) -> Float[np.ndarray, "x y z"]:
    """Return a signed distance without the valleys in front of and behind the crotch; the same with a skirt or coat.

    Cloth hangs from leg to leg there, and few frames show what is behind it. Each horizontal slice in which the solid
    joins both legs is closed by a disc, which does not change the outline from in front, and thighs hide it from the
    side; then all is smoothed. The slices below, in which the legs are apart, stay.

    distance_m: of the solid, negative inside.
    """
    middle, crotch, spacing_m = grid.middle(), grid.row(grid.crotch_m), grid.spacing_m
    if not middle or grid.hem_m is not None:
        return distance_m
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
