"""The palette of a painting on a diffuse map, by optimal transport of colours in CIELAB, without learned weights.

Colours: sliced optimal transport (Pitie, Kokaram and Dahyot, "Automated colour grading using colour distribution
transfer", CVIU 2007; Rabin et al., "Wasserstein barycenter and its application to texture mixing", 2012). The clouds of
colours are projected on the axes of random orthonormal bases; on each axis sorted values are matched with sorted
values. Of the result only hue and chroma are taken. Lightness gets the one-dimensional optimal transport instead, which
is monotone: what is lighter stays lighter, so that folds, seams and eyes keep their drawing. The change of hue and
chroma is smoothed along the map's own edges, because transport magnifies noise (Rabin, Delon and Gousseau, "Removing
artefacts from color and contrast modifications", 2011; here by a guided filter, He, Sun and Tang 2010).
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import special_ortho_group

ITERATIONS = 20
"""Random bases; Pitie et al. need 10 to 20."""

MAX_COLOURS = 50_000
"""Colours of each picture that determine the transport."""

LIGHTNESS_AMOUNT = 0.5
"""Part of the transport of lightness; all of it takes skin to the extremes of a painting of high contrast."""

MAX_LIGHTNESS_SLOPE = 2.0
"""Largest contrast of the moved lightness: plain clothes would show noise of the video."""

_QUANTILES = 256
_GUIDE_RADIUS_FRACTION, _GUIDE_EPSILON = 1.0 / 128.0, 4.0
"""Guided filter: radius by the side of the map; squared lightness (of 100) below which detail is smoothed."""


def transfer_palette(
    image: Float[np.ndarray, "s s 3"],
    covered: Bool[np.ndarray, "s s"],
    look: Float[np.ndarray, "h w 3"],
    seed: int = 0,
) -> Float[np.ndarray, "s s 3"]:
    """Return an image with the palette of another one; both sRGB in [0, 1].

    Args:
        image: the diffuse map.
        covered: its pixels that count and change; the others stay.
        look: the painting.
        seed: of samples and axes.
    """
    random = np.random.default_rng(seed)
    lab, target = _to_lab(image), _sample(_to_lab(look).reshape(-1, 3), random)
    colours = lab[covered]
    moved = transport_colours(colours, target, random)
    moved[:, 0] = move_lightness(colours[:, 0], target[:, 0])
    change = np.zeros_like(lab)
    change[covered] = moved - colours
    change[..., 1:] = _smooth_along_edges(change[..., 1:], lab[..., 0], covered)
    result = np.array(image, dtype=np.float32)
    result[covered] = _to_rgb(lab + change)[covered]
    return result


def transport_colours(
    colours: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "m 3"], random: np.random.Generator
) -> Float[np.ndarray, "n 3"]:
    """Return colours moved so that their distribution is that of the target: sliced optimal transport."""
    moved, quantiles = colours.astype(np.float64), np.linspace(0.0, 1.0, _QUANTILES)
    for basis in special_ortho_group.rvs(3, size=ITERATIONS, random_state=random):
        sample = _sample(moved, random)
        along, wanted = moved @ basis, target @ basis
        source_levels = np.quantile(sample @ basis, quantiles, axis=0)
        target_levels = np.quantile(wanted, quantiles, axis=0)
        step = [
            np.interp(along[:, axis], source_levels[:, axis], target_levels[:, axis]) - along[:, axis]
            for axis in range(3)
        ]
        moved += np.stack(step, axis=1) @ basis.T
    return moved


def move_lightness(lightness: Float[np.ndarray, "n"], target: Float[np.ndarray, "m"]) -> Float[np.ndarray, "n"]:
    """Return lightness moved towards the target's distribution by an increasing function of limited slope."""
    quantiles = np.linspace(0.0, 1.0, _QUANTILES)
    levels, start = np.unique(np.quantile(lightness, quantiles), return_index=True)
    wanted = np.quantile(target, quantiles)[start]
    if len(levels) == 1:
        return lightness + LIGHTNESS_AMOUNT * (float(np.median(target)) - lightness)
    mixed = levels + LIGHTNESS_AMOUNT * (wanted - levels)
    rise = np.minimum(np.diff(mixed), MAX_LIGHTNESS_SLOPE * np.diff(levels))
    curve = np.concatenate([[0.0], np.cumsum(rise)])
    curve += np.median(mixed) - np.median(curve)
    return np.clip(np.interp(lightness, levels, curve), 0.0, 100.0)


def _smooth_along_edges(
    change: Float[np.ndarray, "s s 2"], lightness: Float[np.ndarray, "s s"], covered: Bool[np.ndarray, "s s"]
) -> Float[np.ndarray, "s s 2"]:
    """Return the guided filter of a change, with lightness as the guide; only covered pixels count."""
    radius_px = max(1, round(len(lightness) * _GUIDE_RADIUS_FRACTION))
    side = (2 * radius_px + 1, 2 * radius_px + 1)
    weight = covered.astype(np.float32)

    def mean(values: np.ndarray) -> np.ndarray:
        return cv2.blur(values.astype(np.float32) * weight, side) / np.maximum(cv2.blur(weight, side), 1e-6)

    middle = mean(lightness)
    variance = np.maximum(mean(lightness**2) - middle**2, 0.0)
    smooth = []
    for channel in np.moveaxis(change, 2, 0):
        average = mean(channel)
        slope = (mean(lightness * channel) - middle * average) / (variance + _GUIDE_EPSILON)
        smooth.append(mean(slope) * lightness + mean(average - slope * middle))
    return np.stack(smooth, axis=2)


def _sample(colours: Float[np.ndarray, "n 3"], random: np.random.Generator) -> Float[np.ndarray, "m 3"]:
    if len(colours) <= MAX_COLOURS:
        return colours
    return colours[random.choice(len(colours), MAX_COLOURS, replace=False)]


def _to_lab(rgb: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(rgb, np.float32), cv2.COLOR_RGB2LAB))


def _to_rgb(lab: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    rgb = cv2.cvtColor(np.ascontiguousarray(lab, np.float32), cv2.COLOR_LAB2RGB)
    return np.clip(np.asarray(rgb), 0.0, 1.0)
