"""Alpha mattes of the person from the detector's coarse mask, and colour decontamination. Pure functions.

Notation: I observed colour of a pixel, F and B colours of foreground (person) and background around it, alpha the
covered fraction of the pixel: I = alpha F + (1 - alpha) B. Alphas are float32 in [0, 1].
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from pipeline.capture.masks.background_plate import (
    BackgroundPlate,
    PlateComparison,
    compare_with_plate,
    largest_difference,
    least_alpha,
)
from pipeline.capture.masks.colour_distribution import (
    ColourDistribution,
    fisher_discriminant,
    local_colour_distribution,
    log_density,
)

# The detector's mask has 256 cells on a square of 1.25 times the person's height.
_MASK_CELLS_PER_PERSON_HEIGHT = 256 / 1.25
# In cells: half width of the unknown band around the detector's outline, and radius of the colour window. Radii of
# 3 / 6 / 9 / 12 cells give an IoU of 0.983 / 0.985 / 0.985 / 0.984 on the green-screen capture.
_UNKNOWN_BAND_CELLS, _COLOUR_WINDOW_CELLS = 3.0, 6.0
# Weight of the detector's mask, in units of a squared Mahalanobis distance: at its outline, and far from it.
_PRIOR_WEIGHT_AT_EDGE, _PRIOR_WEIGHT_CERTAIN = 0.3, 10.0
_PRIOR_RAMP = 0.2
# The background is uniform (synthetic) if this fraction of its pixels is within two levels of one colour.
_MIN_UNIFORM_FRACTION, _UNIFORM_TOLERANCE_LEVELS = 0.95, 2
# The same on every fourth pixel outside of the mask, some of which show what the mask misses.
_UNIFORM_TEST_STRIDE, _MIN_UNIFORM_FRACTION_SAMPLED = 4, 0.8
# Above this mask value a pixel is a foreground sample even if the first iteration rejected it. Without that a white hem
# in front of a white wall is lost (synthetic captures, IoU median and worst: 0.978, 0.945; with it 0.991, 0.959).
_CONFIDENT_MASK_VALUE = 0.97
# Minimum logarithm of the ratio of likelihoods, plate to person, mean over 3 x 3 pixels, for background.
_MIN_LOG_RATIO = 4.0
# The opposite at most, and where the plate is far off: one such pixel keeps its neighbours.
_FAR_LOG_RATIO = 20.0
# Half width of the soft rim: this many standard deviations of the image's own blur, at least the minimum.
_MIN_RIM_PX, _RIM_PER_BLUR = 1.0, 2.0
# Blur estimation: standard deviation of the second blur, window in cells along the outline, and the apparent variance
# (px^2) of a sharp edge (area of a pixel and smoothing of the gradient filter).
_REBLUR_PX, _BLUR_CELLS, _INTRINSIC_BLUR_VARIANCE_PX2 = 1.5, 9.0, 0.95
# Distances from the soft rim at which colours are pure foreground or background: lens and codec mix colours over a
# wider strip than alpha shows (docs/decisions/capture.md).
_FOREGROUND_MARGIN_PX, _BACKGROUND_MARGIN_PX = 1.0, 2.5
# Minimum mask level with any trace of the person.
_MIN_TRACE_LEVEL = 25
# Components below this fraction of the person's area are specks, holes below the other fraction are noise.
_MIN_COMPONENT_FRACTION, _MAX_HOLE_FRACTION = 0.05, 2e-4


def estimate_alpha_matte(
    rgb: UInt8[np.ndarray, "h w 3"], mask: UInt8[np.ndarray, "h w"], plate: BackgroundPlate | None = None
) -> Float[np.ndarray, "h w"]:
    """Refine a soft coarse mask (0..255) to an alpha matte with the edges of the image.

    Colour distributions of foreground and background are estimated around each pixel in Gaussian windows. Alpha is the
    position of the pixel's colour between both means along Fisher's linear discriminant. It is averaged with the coarse
    mask, weighted by certainty: the squared Mahalanobis distance of the distributions, and the distance of the mask
    from 0.5. Two iterations, so that the distributions use the better outline. Only a band around the outline can be
    added to the mask. Pixels in the band that differ from `plate` are foreground, and pixels that the plate explains
    better than the person's colours do are background.
    """
    if not (mask > 127).any():
        return np.zeros(mask.shape, dtype=np.float32)
    window = _bounding_slices(
        mask > _MIN_TRACE_LEVEL,
        margin_px=round((_UNKNOWN_BAND_CELLS + 2 * _COLOUR_WINDOW_CELLS) * _mask_cell_px(mask > 127)) + 2,
    )
    image = rgb[window].astype(np.float32) / 255.0
    coarse_alpha = mask[window].astype(np.float32) / 255.0
    cell_px = _mask_cell_px(coarse_alpha > 0.5)
    unknown_band = _dilate(coarse_alpha > 0.5, _UNKNOWN_BAND_CELLS * cell_px)
    seen = None if plate is None else compare_with_plate(rgb[window], plate.window(*window), unknown_band)
    alpha = coarse_alpha
    for iteration in range(2):
        person = _person_colours(image, alpha, coarse_alpha, cell_px)
        alpha = _update_alpha(image, alpha, coarse_alpha, cell_px, person)
        if iteration == 0:
            blur_px = estimate_edge_blur_px(image, alpha > 0.5, _BLUR_CELLS * cell_px)
            rim_px = np.clip(_RIM_PER_BLUR * blur_px, _MIN_RIM_PX, _UNKNOWN_BAND_CELLS * cell_px)
            if seen is not None:
                covered = least_alpha(seen.difference, _typical_px(rim_px, blur_px > 0.0))
        if seen is not None:
            alpha = np.maximum(np.where(_shows_plate(image, person, seen, unknown_band), 0.0, alpha), covered)
        alpha = np.where(unknown_band, alpha, 0.0).astype(np.float32)
    full_alpha = np.zeros(mask.shape, dtype=np.float32)
    alpha = clean_alpha_matte(alpha, rim_px)
    full_alpha[window] = alpha if seen is None else _fill_prints(alpha, coarse_alpha, seen.known, cell_px)
    return full_alpha


def estimate_edge_blur_px(
    image: Float[np.ndarray, "h w 3"], body: Bool[np.ndarray, "h w"], window_px: float
) -> Float[np.ndarray, "h w"]:
    """Return the blur of the image at the outline near each pixel: standard deviation of a Gaussian, px.

    An edge of blur s that is blurred again by r keeps s^2 / (s^2 + r^2) of its squared gradient, for any contrast (Zhuo
    and Sim, "Defocus map estimation from a single image", 2011). Both energies are summed along the outline in squares
    of half width `window_px`, so strong edges dominate; 0 far from the outline.
    """
    line, side = _dilate(inner_boundary(body), 1.0), 2 * round(window_px) + 1
    sharp, soft = (
        cv2.blur(_squared_gradient(picture, line), (side, side))
        for picture in (image, cv2.GaussianBlur(image, (0, 0), _REBLUR_PX))
    )
    excess = np.maximum(sharp - soft, 1e-6)
    return np.sqrt(np.maximum(_REBLUR_PX**2 * soft / excess - _INTRINSIC_BLUR_VARIANCE_PX2, 0.0)).astype(np.float32)


def _squared_gradient(image: Float[np.ndarray, "h w 3"], at: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Return the squared gradient (Sobel's) of some pixels, summed over channels; 0 at the others and at the border."""
    rows, columns = np.nonzero(at[1:-1, 1:-1])
    west, middle, east = ([image[rows + i, columns + j] for i in range(3)] for j in range(3))
    across = (east[0] - west[0]) + 2.0 * (east[1] - west[1]) + (east[2] - west[2])
    down = (west[2] - west[0]) + 2.0 * (middle[2] - middle[0]) + (east[2] - east[0])
    squares = np.zeros(at.shape, dtype=np.float32)
    squares[rows + 1, columns + 1] = (across**2 + down**2).sum(axis=1)
    return squares


def clean_alpha_matte(
    alpha: Float[np.ndarray, "h w"], rim_px: float | Float[np.ndarray, "h w"] = _MIN_RIM_PX
) -> Float[np.ndarray, "h w"]:
    """Remove specks and pinholes; set 1 inside and 0 outside except within `rim_px` of the outline, where alpha stays
    soft.

    Gaps larger than noise (between arm and torso) and large separate components stay.
    """
    body = _large_components(alpha > 0.5)
    body = ~_remove_small_components(~body, _MAX_HOLE_FRACTION * body.sum())
    outer, inner = _dilate(body, rim_px), ~_dilate(~body, rim_px)
    soft = np.where(body, np.maximum(alpha, 0.5), np.minimum(alpha, 0.5))
    return np.where(inner, 1.0, np.where(outer, soft, 0.0)).astype(np.float32)


def decontaminate_colours(
    rgb: UInt8[np.ndarray, "h w 3"], alpha: UInt8[np.ndarray, "h w"], *, is_own_alpha: bool = False
) -> UInt8[np.ndarray, "h w 3"]:
    """Replace the background's contribution to pixels of partial alpha (1 to 254) by the foreground colour.

    With F' and B', the colours of the nearest pure foreground and background pixels, a pixel becomes I + (1 - alpha)
    (F' - B'), which is alpha F + (1 - alpha) F' if B' = B; nothing is divided by a small alpha. All other pixels stay,
    and all pixels if there is no pure foreground or background.

    is_own_alpha: the image came with alpha. Straight alpha leaves F in soft pixels, and they stay; cut-outs that were
        blended with black (rembg) or reduced without regard to alpha hold B as well. The part of (1 - alpha) (F' - B')
        that soft pixels lack of F', a least-squares fit of premultiplied colours, is added.
    """
    soft = (alpha > 0) & (alpha < 255)
    if not soft.any():
        return rgb
    window = _bounding_slices(alpha > 0, margin_px=8)
    sides = [
        ~_dilate(mixed, clear_px)
        for mixed, clear_px in (
            (alpha[window] < 255, _FOREGROUND_MARGIN_PX),
            (alpha[window] > 0, _BACKGROUND_MARGIN_PX),
        )
    ]
    if not all(side.any() for side in sides):
        return rgb
    soft = soft[window]
    person, backdrop = (
        rgb[window].reshape(-1, 3)[_nearest_pixel_index(side)[soft]].astype(np.float32) for side in sides
    )
    covered = alpha[window][soft, None] / np.float32(255.0)
    observed, missing = rgb[window][soft].astype(np.float32), (1.0 - covered) * (person - backdrop)
    if is_own_alpha:
        weighted = covered**2 * missing
        lacking, whole = (float((weighted * colours).sum()) for colours in (person - observed, missing))
        missing *= np.float32(np.clip(lacking / max(whole, 1.0), 0.0, 1.0))
    result = rgb.copy()
    result[window][soft] = np.rint(np.clip(observed + missing, 0.0, 255.0))
    return result


def resize_premultiplied(
    image: Float[np.ndarray, "h w 3"], alpha: Float[np.ndarray, "h w"], size: tuple[int, int]
) -> tuple[Float[np.ndarray, "h2 w2 3"], Float[np.ndarray, "h2 w2"]]:
    """Resize image and alpha to (columns, rows) by area averaging of premultiplied colours; black where alpha is 0."""
    reduced, premultiplied = (
        cv2.resize(array, size, interpolation=cv2.INTER_AREA) for array in (alpha, image * alpha[..., None])
    )
    return premultiplied / np.maximum(reduced, np.float32(1e-6))[..., None], reduced


def extend_mask_on_uniform_background(
    rgb: UInt8[np.ndarray, "h w 3"], mask: UInt8[np.ndarray, "h w"]
) -> UInt8[np.ndarray, "h w"]:
    """Add foreground that the mask misses in front of a uniform synthetic background (a recording that is matted
    already).

    This applies only if nearly all background pixels have exactly one colour, which no camera records. Pixels of
    another colour are added if they are connected to the person and farther from the mask than the detector's error.
    """
    body = mask > 127
    if not body.any():
        return mask
    cell_px = _mask_cell_px(body)
    outside = rgb[::_UNIFORM_TEST_STRIDE, ::_UNIFORM_TEST_STRIDE][
        mask[::_UNIFORM_TEST_STRIDE, ::_UNIFORM_TEST_STRIDE] <= _MIN_TRACE_LEVEL
    ]
    if len(outside) and _is_painted(outside, np.median(outside, axis=0)).mean() < _MIN_UNIFORM_FRACTION_SAMPLED:
        return mask
    near = _dilate(body, _UNKNOWN_BAND_CELLS * cell_px)
    away = rgb[~_dilate(body, 2 * _UNKNOWN_BAND_CELLS * cell_px)]
    if len(away) == 0:
        return mask
    painted = _is_painted(rgb, np.median(away, axis=0))
    if painted[~near].mean() < _MIN_UNIFORM_FRACTION:
        return mask
    support = cv2.morphologyEx((~painted).astype(np.uint8), cv2.MORPH_OPEN, np.ones((5, 5), np.uint8)) > 0
    _, labels = cv2.connectedComponents((support | body).astype(np.uint8), connectivity=8)
    attached = support & np.isin(labels, np.unique(labels[body]))
    beyond = _dilate(attached & ~near, 2 * _UNKNOWN_BAND_CELLS * cell_px)
    return np.where(attached & beyond, np.uint8(255), mask)


def _is_painted(colours: UInt8[np.ndarray, "*k 3"], backdrop: Float[np.ndarray, "3"]) -> Bool[np.ndarray, "*k"]:
    """Return which colours are that of the backdrop."""
    return (np.abs(colours.astype(np.int16) - backdrop.astype(np.int16)) <= _UNIFORM_TOLERANCE_LEVELS).all(axis=-1)


def smooth_mask_temporally(
    images: UInt8[np.ndarray, "t h w 3"], masks: UInt8[np.ndarray, "t h w"], centre: int, noise: float
) -> UInt8[np.ndarray, "h w"]:
    """Average the mask at time `centre` with masks of other times where the image is the same.

    The weight of another time decreases with the squared change of the slightly blurred colour in units of `noise`
    (levels of 255), so moving limbs are not smoothed.
    """
    blurred = [cv2.blur(image, (5, 5)) for image in images]
    falloff = np.exp(-((np.arange(256) / (3.0 * noise)) ** 2)).astype(np.float32)
    total = masks[centre].astype(np.float32)
    weights = np.ones_like(total)
    for time in range(len(images)):
        if time != centre:
            weight = cv2.LUT(largest_difference(blurred[time], blurred[centre]), falloff)
            total += weight * masks[time]
            weights += weight
    return np.rint(total / weights).astype(np.uint8)


def definite_background(mask: UInt8[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Return where even the outermost rim of a soft mask, and half a cell around it, shows no person."""
    seen = mask > _MIN_TRACE_LEVEL
    return ~_dilate(seen, 0.5 * _mask_cell_px(seen)) if seen.any() else ~seen


def inner_boundary(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Return the pixels of the mask that touch its outside."""
    return mask & (cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) == 0)


def _mask_cell_px(person: Bool[np.ndarray, "h w"]) -> float:
    """Return the size of a cell of the detector's mask in pixels of this image, at least one."""
    rows = np.flatnonzero(person.any(axis=1))
    return max(1.0, float(rows[-1] - rows[0] + 1) / _MASK_CELLS_PER_PERSON_HEIGHT)


def _bounding_slices(mask: Bool[np.ndarray, "h w"], margin_px: int) -> tuple[slice, slice]:
    """Return rows and columns of the mask's bounding box with a margin, inside the image."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return (
        slice(max(0, rows[0] - margin_px), rows[-1] + margin_px + 1),
        slice(max(0, columns[0] - margin_px), columns[-1] + margin_px + 1),
    )


def _typical_px(lengths_px: Float[np.ndarray, "h w"], where: Bool[np.ndarray, "h w"]) -> int:
    """Return the median of some lengths, rounded; at least 1."""
    return max(1, round(float(np.median(lengths_px[where])))) if where.any() else 1


def _person_colours(
    image: Float[np.ndarray, "h w 3"],
    alpha: Float[np.ndarray, "h w"],
    coarse_alpha: Float[np.ndarray, "h w"],
    cell_px: float,
) -> ColourDistribution:
    """Return the colours of the person around each point of a grid as coarse as the detector's."""
    height, width = alpha.shape
    grid = max(1, round(width / cell_px)), max(1, round(height / cell_px))
    inside = np.maximum(alpha, coarse_alpha > _CONFIDENT_MASK_VALUE)
    weight = np.clip(2.0 * inside - 1.0, 0.0, 1.0) ** 2
    return local_colour_distribution(image, weight, grid, round(_COLOUR_WINDOW_CELLS))


def _shows_plate(
    image: Float[np.ndarray, "h w 3"],
    person: ColourDistribution,
    seen: PlateComparison,
    unknown_band: Bool[np.ndarray, "h w"],
) -> Bool[np.ndarray, "h w"]:
    """Return the pixels of the band that the plate explains better than the colours of the person do, with their
    neighbours.
    """
    rows, columns = np.nonzero(seen.is_near & unknown_band)
    pixels = rows, columns
    log_ratio = np.where(seen.known, np.float32(_FAR_LOG_RATIO), np.float32(0.0))
    log_ratio[pixels] = np.minimum(log_density(image, person, pixels) - seen.log_density[pixels], _FAR_LOG_RATIO)
    return seen.known & (cv2.blur(log_ratio, (3, 3)) < -_MIN_LOG_RATIO)


def _fill_prints(
    alpha: Float[np.ndarray, "h w"],
    coarse_alpha: Float[np.ndarray, "h w"],
    known: Bool[np.ndarray, "h w"],
    cell_px: float,
) -> Float[np.ndarray, "h w"]:
    """Set alpha to 1 in mostly opaque parts inside the person where the recording never shows the scene behind.

    A print in the colour of the wall looks like a gap; a gap between arm and trunk shows the wall, which other frames
    show too.
    """
    inside = ~_dilate(coarse_alpha <= 0.5, cell_px) & (coarse_alpha > _CONFIDENT_MASK_VALUE)
    count, labels = cv2.connectedComponents(((alpha < 1.0) & inside).astype(np.uint8), connectivity=8)
    opacity, hidden, area = (
        np.bincount(labels.ravel(), None if weight is None else weight.ravel(), count)
        for weight in (alpha, ~known, None)
    )
    is_print = (opacity > 0.5 * area) & (hidden > 0.5 * area)
    is_print[0] = False
    return np.where(is_print[labels], np.float32(1.0), alpha)


def _update_alpha(
    image: Float[np.ndarray, "h w 3"],
    alpha: Float[np.ndarray, "h w"],
    coarse_alpha: Float[np.ndarray, "h w"],
    cell_px: float,
    person: ColourDistribution,
) -> Float[np.ndarray, "h w"]:
    """Return alpha after one iteration of `estimate_alpha_matte`.

    person: colours of the person around each point of a grid as coarse as the detector's. They are smooth, and the
    discriminant is, so both are computed there and enlarged.
    """
    height, width = alpha.shape
    weight = np.clip(1.0 - 2.0 * alpha, 0.0, 1.0) ** 2
    rows, columns = person.weight.shape
    background = local_colour_distribution(image, weight, (columns, rows), 2 * round(_COLOUR_WINDOW_CELLS))
    direction, offset, certainty = (
        cv2.resize(field, (width, height), interpolation=cv2.INTER_LINEAR)
        for field in fisher_discriminant(person, background)
    )
    position = cv2.transform(cv2.multiply(image, direction), np.ones((1, 3), dtype=np.float32)) - offset
    prior = np.clip((coarse_alpha - 0.5) / (2.0 * _PRIOR_RAMP) + 0.5, 0.0, 1.0)
    prior_weight = _PRIOR_WEIGHT_AT_EDGE + _PRIOR_WEIGHT_CERTAIN * (2.0 * coarse_alpha - 1.0) ** 2
    total = certainty * np.clip(position, -0.2, 1.2) + prior_weight * prior
    return np.clip(total / (certainty + prior_weight), 0.0, 1.0)


def _nearest_pixel_index(wanted: Bool[np.ndarray, "h w"]) -> Int[np.ndarray, "h w"]:
    """Return for every pixel the row-major index of the nearest wanted pixel."""
    _, labels = cv2.distanceTransformWithLabels(
        (~wanted).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    place = np.zeros(int(labels.max()) + 1, dtype=np.int64)
    place[labels[wanted]] = np.flatnonzero(wanted)
    return place[labels]


def _large_components(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Return the largest component and all others that are not small relative to it."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    if count == 1:
        return mask
    areas = stats[1:, cv2.CC_STAT_AREA]
    return np.concatenate([[False], areas >= _MIN_COMPONENT_FRACTION * areas.max()])[labels]


def _remove_small_components(mask: Bool[np.ndarray, "h w"], smallest_area_px: float) -> Bool[np.ndarray, "h w"]:
    """Return the components with at least this area."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    keep = stats[:, cv2.CC_STAT_AREA] >= smallest_area_px
    keep[0] = False
    return keep[labels]


def _dilate(mask: Bool[np.ndarray, "h w"], radius_px: float | Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Return all pixels within a distance of the mask; by distance transform, so the cost does not depend on the
    radius.
    """
    if not mask.any():
        return mask.copy()
    return cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5) <= radius_px
