"""Specular highlights of the video: the lamp, an exponent for each region, and a strength at each vertex.

Camera and lamps are static while the person turns. The linear colour of a vertex in a frame, divided by the gain, is

    y = albedo * E(n) + s * D,    D = v max(0, n . h)^p  where the surface faces the lamp,

the reflection model of Blinn ("Models of light reflection for computer synthesized pictures", 1977) with the half
vector h between the lamp and the camera. E is known (`pipeline.texture.light`); direction of the lamp and exponent p
are those that explain most, the strength s >= 0 of a vertex follows from linear regression, with its albedo eliminated.
Highlights are grey, because dielectrics reflect light without colouring it, and a region of the surface (of one albedo
and one place: a material) keeps them only if they predict its colours in validation frames: errors of pose and normals
change the colour of a vertex with the view as well. Where frames do not tell the strength, it is that of the region;
nowhere is it above the confidence interval of the vertex's own regression, so that it ends where the shine ends.

The exponent of a region is the one that leaves the least error in training frames, where it differs from that of the
whole person by `MIN_STANDARD_ERRORS`; the whole person has one if validation frames do not prefer those of regions by
as many.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_array, eye_array

from pipeline.geometry.colour import linear_to_srgb
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import laplacian
from pipeline.texture.light import Highlights, VideoLight, roughness_of_exponent
from pipeline.texture.lighting.key_light import SEARCH_REFINEMENTS_RAD, directions_around, search_directions
from pipeline.texture.lighting.light_fit import ViewObservations
from pipeline.texture.lighting.material_regions import material_regions
from pipeline.texture.lighting.specular_regression import HighlightRegression, ridge

EXPONENTS = (12.0, 24.0, 48.0, 96.0)
"""Candidates of p: roughness 0.61 to 0.38. Errors of the irradiance look like wider lobes."""

FINE_EXPONENTS = (12.0, 16.0, 24.0, 32.0, 48.0, 64.0, 96.0)
"""Candidates once the lamp is known: steps of 6 to 10 % of the roughness."""

MAX_LAMP_ANGLE_RAD = 0.8

REFINEMENTS_RAD = (0.25, 0.12, 0.06)
"""Steps of the direction of the lamp once regions with highlights are known, each with an exponent of its own."""

MAX_STEPS = 2
"""Of the direction, for each of `REFINEMENTS_RAD`."""

ALBEDO_CONTRAST_SCALE = 0.05
SMOOTHING_STEPS = 6

MIN_EXPLAINED, MIN_STANDARD_ERRORS = 0.4, 2.0
"""What highlights must explain of the squared error of validation frames in the regions that keep them. Regions of a
shiny shirt: 0.46 to 0.86; of five matte people, 40 regions each: at most 0.24."""

MIN_REGION_STANDARD_ERRORS = 1.0
"""The same of one region: half, since few validation frames see it; all regions together need `MIN_STANDARD_ERRORS`."""

REGION_SMOOTHING_STEPS = 2
"""Of the strength, across the borders of regions."""


@dataclass(frozen=True)
class SpecularFit:
    """Result of the specular fit.

    Attributes:
        highlights: the lamp, and the lobe of the whole person.
        strength: linear radiance that a highlight adds to each vertex at its peak; all 0 for a matte surface.
        roughness: glTF's, of the lobe of each vertex; None where that of `highlights` is the only one.
        explained: fraction of the squared error of validation frames that highlights explain, in the regions that keep
            them, on the whole person if none does; negative if they increase it.
        standard_errors: mean decrease of that error over frames, divided by its standard error.
        regions: number of regions with highlights.
        roughness_standard_errors: the same as `standard_errors` for exponents of the regions' own against one for all;
            0 where all regions have the same.
    """

    highlights: Highlights
    strength: Float[np.ndarray, "v"]
    roughness: Float[np.ndarray, "v"] | None
    explained: float
    standard_errors: float
    regions: int
    roughness_standard_errors: float = 0.0

    @staticmethod
    def matte(vertex_count: int) -> "SpecularFit":
        """Return the result for a surface without highlights that was not tested."""
        return SpecularFit(Highlights.none(), np.zeros(vertex_count, dtype=np.float32), None, 0.0, 0.0, 0)

    def metrics(self) -> dict[str, float]:
        """Return the figures of the fit for the manifest."""
        return {
            "specular_explained": self.explained,
            "specular_standard_errors": self.standard_errors,
            "specular_regions": float(self.regions),
            "roughness_standard_errors": self.roughness_standard_errors,
        }


def fit_specular(train: ViewObservations, validation: ViewObservations, light: VideoLight, mesh: Mesh) -> SpecularFit:
    """Fit lamp, exponents and strengths to training views, and test them on validation views.

    light: with or without shadows of a key light.
    """
    count = len(mesh.vertices)
    surface = _Surface.of_views(train, validation, light, mesh)
    first = find_lobe(surface.fitted, light, count)
    matte, lit = surface.matte_errors(), _fit_lobe(surface, first, np.full(count, first.exponent))
    shiny = _shiny_regions(surface, matte, lit.tested_error)
    explained, errors = _decrease(surface, matte, lit.tested_error, shiny)
    if not len(shiny) or explained < MIN_EXPLAINED or errors < MIN_STANDARD_ERRORS:
        return SpecularFit(first, np.zeros(count, dtype=np.float32), None, explained, errors, 0)
    direction = first.direction if light.casts_shadows else _refine_direction(surface, shiny, first.direction, light)
    whole, chosen, roughness_errors = _choose_exponents(surface, matte, shiny, direction)
    shiny = _shiny_regions(surface, matte, chosen.tested_error)
    strength, roughness = _strength_and_roughness(surface, chosen, shiny, whole)
    explained, errors = _decrease(surface, matte, chosen.tested_error, shiny)
    own = roughness if roughness_errors > 0.0 else None
    return SpecularFit(Highlights(direction, whole), strength, own, explained, errors, len(shiny), roughness_errors)


@dataclass(frozen=True)
class _Surface:
    """What lobes are fitted to and tested on.

    Attributes:
        fitted, tested: what training and validation views show.
        region: of each vertex.
        mixing: averages a value of each vertex with those of its neighbours.
    """

    fitted: HighlightRegression
    tested: HighlightRegression
    region: Int[np.ndarray, "v"]
    mixing: csr_array

    @staticmethod
    def of_views(train: ViewObservations, validation: ViewObservations, light: VideoLight, mesh: Mesh) -> "_Surface":
        fitted, tested = (HighlightRegression.of_views(each, light) for each in (train, validation))
        albedo = linear_to_srgb(fitted.albedo(len(mesh.vertices), 0.0))
        uniformity = albedo_uniformity(albedo, mesh.edges())
        fitted, tested = (each.weighted(uniformity[each.vertex]) for each in (fitted, tested))
        return _Surface(fitted, tested, material_regions(albedo, mesh.vertices), _mixing(mesh))

    def matte_errors(self) -> Float[np.ndarray, "k"]:
        """Return the error of each row of the validation views without highlights."""
        return self.tested.squared_errors(np.zeros(len(self.tested.vertex)), self.fitted.albedo(len(self.region), 0.0))


@dataclass(frozen=True)
class _LobeFit:
    """Strengths under a lamp and an exponent at each vertex.

    Attributes:
        exponent: of each vertex.
        power, product: of the normal equations of each vertex.
        largest: strength that the rows of a vertex allow, see `HighlightRegression.largest_strength`.
        fitted_error, tested_error: weighted squared errors of the rows of training and validation views.
    """

    exponent: Float[np.ndarray, "v"]
    power: Float[np.ndarray, "v"]
    product: Float[np.ndarray, "v"]
    largest: Float[np.ndarray, "v"]
    fitted_error: Float[np.ndarray, "k"]
    tested_error: Float[np.ndarray, "l"]


def _fit_lobe(surface: _Surface, highlights: Highlights, exponent: Float[np.ndarray, "v"]) -> _LobeFit:
    """Fit the strengths to training views; highlights: for the direction of the lamp."""
    count, fitted, tested = len(exponent), surface.fitted, surface.tested
    lobe = fitted.lobe(highlights, exponent)
    power, products = fitted.normal_equations(lobe, count)
    product = products.min(axis=1)
    largest = fitted.largest_strength(lobe, count)
    strength = _smooth(power, product, np.zeros(count), surface.mixing)
    highlight = lobe * strength[fitted.vertex]
    albedo = fitted.albedo(count, highlight)
    tested_highlight = tested.lobe(highlights, exponent) * strength[tested.vertex]
    return _LobeFit(
        exponent,
        power,
        product,
        largest,
        fitted.squared_errors(highlight, albedo),
        tested.squared_errors(tested_highlight, albedo),
    )


def _decrease(
    surface: _Surface, before: Float[np.ndarray, "l"], after: Float[np.ndarray, "l"], regions: Int[np.ndarray, "s"]
) -> tuple[float, float]:
    """Return `HighlightRegression.decrease` of validation views in some regions; in all if there are none."""
    everywhere = np.ones(len(before), dtype=bool)
    rows = np.isin(surface.region[surface.tested.vertex], regions) if len(regions) else everywhere
    return surface.tested.decrease(before, after, rows)


def _shiny_regions(
    surface: _Surface, without: Float[np.ndarray, "l"], with_lobe: Float[np.ndarray, "l"]
) -> Int[np.ndarray, "s"]:
    """Return the regions whose colours in validation frames highlights predict; errors: squared, one a row."""
    tested, region = surface.tested, surface.region[surface.tested.vertex]
    scores = [tested.decrease(without, with_lobe, region == label) for label in range(int(surface.region.max()) + 1)]
    return np.flatnonzero([share > MIN_EXPLAINED and errors > MIN_REGION_STANDARD_ERRORS for share, errors in scores])


def _refine_direction(
    surface: _Surface, shiny: Int[np.ndarray, "s"], start: Float[np.ndarray, "3"], light: VideoLight
) -> Float[np.ndarray, "3"]:
    """Return the direction of the lamp that explains most of regions with highlights, each with its best exponent.

    One exponent for all would turn the lamp: at a wrong angle, wide lobes look like the sides of narrow ones.
    """
    count = len(surface.region)
    fitted = surface.fitted.select(np.isin(surface.region[surface.fitted.vertex], shiny))

    def explained(direction: Float[np.ndarray, "3"]) -> float:
        gains = []
        for exponent in EXPONENTS:
            power, products = fitted.normal_equations(fitted.lobe(Highlights(direction, exponent)), count)
            strength = _smooth(power, products.min(axis=1), np.zeros(count), surface.mixing)
            gain = 2.0 * strength * products.sum(axis=1) - 3.0 * strength**2 * power
            gains.append(np.bincount(surface.region, gain))
        return float(np.max(gains, axis=0).sum())

    best, most = start, explained(start)
    for angle_rad in REFINEMENTS_RAD:
        for _ in range(MAX_STEPS):
            near = directions_around(best, angle_rad)
            near = near[near @ light.dominant_direction() > np.cos(MAX_LAMP_ANGLE_RAD)]
            scores = [explained(direction) for direction in near]
            if not scores or max(scores) <= most:
                break
            best, most = near[int(np.argmax(scores))], max(scores)
    return best


def _choose_exponents(
    surface: _Surface,
    matte: Float[np.ndarray, "l"],
    shiny: Int[np.ndarray, "s"],
    direction: Float[np.ndarray, "3"],
) -> tuple[float, _LobeFit, float]:
    """Choose the exponent of the whole person and those of regions.

    Returns:
        The exponent of the whole person, what is fitted with the chosen ones, and by how many standard errors those of
        regions predict validation views better; 0 where all are that of the whole person.
    """
    fitted, count = surface.fitted, len(surface.region)
    region = surface.region[fitted.vertex]
    lobes = [_fit_lobe(surface, Highlights(direction, p), np.full(count, p)) for p in FINE_EXPONENTS]
    here = np.isin(region, shiny)
    whole = int(np.argmin([lobe.fitted_error[here].sum() for lobe in lobes]))
    totals = np.stack([np.bincount(region, lobe.fitted_error, int(surface.region.max()) + 1) for lobe in lobes])
    best = totals.argmin(axis=0)
    for label in np.flatnonzero(best != whole).tolist():
        _, errors = fitted.decrease(lobes[whole].fitted_error, lobes[best[label]].fitted_error, region == label)
        if errors < MIN_STANDARD_ERRORS:
            best[label] = whole
    one = lobes[whole]
    exponent = np.array(FINE_EXPONENTS)[best][surface.region]
    own = _fit_lobe(surface, Highlights(direction, FINE_EXPONENTS[whole]), exponent)
    kinds = _shiny_regions(surface, matte, own.tested_error)
    if len(np.unique(best[kinds])) > 1:
        _, errors = _decrease(surface, one.tested_error, own.tested_error, kinds)
        if errors > MIN_STANDARD_ERRORS:
            return FINE_EXPONENTS[whole], own, errors
    return FINE_EXPONENTS[whole], one, 0.0


def _strength_and_roughness(
    surface: _Surface, lobe: _LobeFit, shiny: Int[np.ndarray, "s"], whole: float
) -> tuple[Float[np.ndarray, "v"], Float[np.ndarray, "v"]]:
    """Return the strength of the vertices of shiny regions, and their roughness, both smoothed across borders.

    whole: exponent of the whole person, which other regions take.
    """
    region, is_shiny = surface.region, np.isin(surface.region, shiny)
    mean = np.bincount(region, np.maximum(lobe.product, 0.0)) / np.maximum(np.bincount(region, lobe.power), 1e-12)
    strength = is_shiny * _smooth(lobe.power, lobe.product, mean[region], surface.mixing)
    strength = np.minimum(strength, lobe.largest)
    roughness = roughness_of_exponent(np.where(is_shiny, lobe.exponent, whole))
    for _ in range(REGION_SMOOTHING_STEPS):
        weighted, strength = surface.mixing @ (strength * roughness), surface.mixing @ strength
        roughness = np.where(strength > 0.0, weighted / np.maximum(strength, 1e-12), roughness)
    strength = np.minimum(strength, lobe.largest)
    return strength.astype(np.float32), roughness.astype(np.float32)


def find_lobe(fitted: HighlightRegression, light: VideoLight, vertex_count: int) -> Highlights:
    """Return the direction and the exponent that explain most of the training views.

    The key light is the lamp where its shadows are known; otherwise directions are tried within `MAX_LAMP_ANGLE_RAD` of
    that from which most light comes: errors of normals look like highlights of lamps that give no light. Lamps are not
    below the person; where most light comes from below, the nearest direction is tried.
    """
    directions = light.key_direction[None]
    if not light.casts_shadows:
        directions = search_directions()
        cosine = directions @ light.dominant_direction()
        directions = directions[cosine >= min(np.cos(MAX_LAMP_ANGLE_RAD), cosine.max())]

    def explained(highlights: Highlights) -> float:
        return fitted.explained(fitted.lobe(highlights), vertex_count)

    candidates = [Highlights(direction, exponent) for direction in directions for exponent in EXPONENTS]
    best = max(candidates, key=explained)
    for angle_rad in () if light.casts_shadows else SEARCH_REFINEMENTS_RAD:
        near = directions_around(best.direction, angle_rad)
        near = near[near @ light.dominant_direction() > np.cos(MAX_LAMP_ANGLE_RAD)]
        best = max([best, *(replace(best, direction=each) for each in near)], key=explained)
    return max((replace(best, exponent=exponent) for exponent in EXPONENTS), key=explained)


def dielectric_specular_factor(
    strength: Float[np.ndarray, "*n"], roughness: Float[np.ndarray, "*n"] | float, lamp_irradiance: float
) -> Float[np.ndarray, "*n"]:
    """Return glTF's specular factor, in [0, 1], of a dielectric that shows highlights of this strength.

    glTF's microfacet model (specification, appendix B; alpha = roughness^2) reflects 4 % of the light along the normal.
    At the peak of a highlight, where D = 1 / (pi alpha^2) and V = 1/4, the added radiance is
    pi * 0.04 * D * V = 0.01 / alpha^2 under a lamp that renders a white diffuse surface as 1. The factor is clipped at
    1, since few dielectrics reflect more.

    Args:
        strength: linear radiance at the peak of the highlight.
        roughness: glTF's, in [0, 1].
        lamp_irradiance: of a surface that faces the lamp; 1 renders a white diffuse surface as 1.
    """
    return np.clip(strength * roughness**4 / (0.01 * lamp_irradiance), 0.0, 1.0)


def _smooth(
    power: Float[np.ndarray, "v"], product: Float[np.ndarray, "v"], prior: Float[np.ndarray, "v"], mixing: csr_array
) -> Float[np.ndarray, "v"]:
    """Return s >= 0: power and product are pooled over the neighbourhood; s is the prior's where the lobe is weak."""
    regularisation = ridge(power)
    for _ in range(SMOOTHING_STEPS):
        power, product = mixing @ power, mixing @ product
    return np.clip((np.maximum(product, 0.0) + regularisation * prior) / (power + regularisation), 0.0, 1.0)


def _mixing(mesh: Mesh) -> csr_array:
    """Return the matrix that averages a value of each vertex with those of its neighbours, half and half."""
    return csr_array(eye_array(len(mesh.vertices)) - 0.5 * laplacian(mesh))


def albedo_uniformity(albedo: Float[np.ndarray, "v 3"], edges: Int[np.ndarray, "e 2"]) -> Float[np.ndarray, "v"]:
    """Return how uniform the albedo (sRGB) is around each vertex, in (0, 1].

    A wrong pose changes the colour of a vertex next to an edge of the albedo as a highlight does. 1 where all
    neighbours have the same colour; 1/4 where the largest difference of a channel is `ALBEDO_CONTRAST_SCALE`
    (Geman-McClure weight).
    """
    difference = np.abs(albedo[edges[:, 0]] - albedo[edges[:, 1]]).max(axis=1)
    largest = np.zeros(len(albedo))
    np.maximum.at(largest, edges.ravel(), np.repeat(difference, 2))
    return 1.0 / (1.0 + (largest / ALBEDO_CONTRAST_SCALE) ** 2) ** 2
