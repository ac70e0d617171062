"""Specular highlights of the video: one lobe, and its strength at each vertex.

Camera and lamps are static while the person turns. The linear colour of a vertex in a frame, divided by the gain, is

    y = albedo * E(n) + s * D,    D = v max(0, n . h)^p  where the surface faces the lamp,

the reflection model of Blinn ("Models of light reflection for computer synthesized pictures", 1977) with the half
vector h between the lamp and the camera. E is known (`pipeline.texture.light`); direction of the lamp and exponent p
are those that explain most, the strength s >= 0 of a vertex follows from linear regression, with its albedo eliminated.
Highlights are grey, because dielectrics reflect light without colouring it, and a region of the surface (of one albedo
and one place: a material) keeps them only if they predict its colours in validation frames: errors of pose and normals
change the colour of a vertex with the view as well. Where frames do not tell the strength, it is that of the region.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_array, eye_array

from pipeline.geometry.atlas import Texels
from pipeline.geometry.colour import linear_to_srgb, srgb_to_linear
from pipeline.geometry.mesh import Mesh
from pipeline.geometry.surface import laplacian
from pipeline.texture.key_light import SEARCH_REFINEMENTS_RAD, directions_around, search_directions
from pipeline.texture.light import Highlights, VideoLight
from pipeline.texture.light_evidence import standard_errors
from pipeline.texture.light_fit import ViewObservations
from pipeline.texture.material_regions import material_regions

EXPONENTS = (12.0, 24.0, 48.0, 96.0)
"""Candidates of p: roughness 0.61 to 0.38. Errors of the irradiance look like wider lobes."""

MAX_LAMP_ANGLE_RAD = 0.8

ALBEDO_CONTRAST_SCALE = 0.05
SMOOTHING_STEPS = 6
RIDGE_FRACTION = 0.003
"""Ridge of the strength, relative to the lobe's power at well-observed vertices of uniform albedo."""

MIN_ROWS = 10
"""Vertices of a region that a validation frame must show to count."""

MIN_LINEAR = 0.02
"""Linear colour below which noise does not fall any more."""

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
        highlights: the lobe.
        strength: linear radiance that a highlight adds to each vertex at its peak; all 0 for a matte surface.
        explained: fraction of the squared error of validation frames that highlights explain, in the regions that keep
            them, on the whole person if none does; negative if they increase it.
        standard_errors: mean decrease of that error over frames, divided by its standard error.
        regions: number of regions with highlights.
    """

    highlights: Highlights
    strength: Float[np.ndarray, "v"]
    explained: float
    standard_errors: float
    regions: int


def texels_at_vertices(faces: Int[np.ndarray, "f 3"], vertex_count: int) -> Texels:
    """Return one "texel" at each vertex that has a face, so that vertices are sampled like texels.

    The column of each texel is its vertex index.
    """
    corners = faces.reshape(-1)
    vertices, first = np.unique(corners, return_index=True)
    barycentric = np.eye(3, dtype=np.float32)[first % 3]
    zeros = np.zeros(len(vertices), dtype=np.int32)
    return Texels(vertex_count, zeros, vertices.astype(np.int32), (first // 3).astype(np.int32), barycentric)


def fit_specular(train: ViewObservations, validation: ViewObservations, light: VideoLight, mesh: Mesh) -> SpecularFit:
    """Fit one lobe and its strength at each vertex to training views, and test them on validation views.

    light: with or without shadows of a key light.
    """
    count, edges = len(mesh.vertices), mesh.edges()
    fitted, tested = (_Regression.of_views(each, light) for each in (train, validation))
    albedo = linear_to_srgb(fitted.albedo(count, 0.0))
    uniformity = albedo_uniformity(albedo, edges)
    fitted, tested = (each.weighted(uniformity[each.vertex]) for each in (fitted, tested))
    highlights = find_lobe(fitted, light, count)
    power, products = fitted.normal_equations(highlights, count)
    product = products.min(axis=1)
    strength = _smooth(power, product, np.zeros(count), mesh)
    without = tested.squared_errors(highlights, np.zeros(count), fitted.albedo(count, 0.0))
    lobe = fitted.lobe(highlights) * strength[fitted.vertex]
    with_lobe = tested.squared_errors(highlights, strength, fitted.albedo(count, lobe))
    region = material_regions(albedo, mesh.vertices)
    shiny = _shiny_regions(region, tested, without, with_lobe)
    kept = np.isin(region, shiny) if len(shiny) else np.ones(count, dtype=bool)
    explained, errors = tested.decrease(without, with_lobe, kept[tested.vertex])
    if not len(shiny) or explained < MIN_EXPLAINED or errors < MIN_STANDARD_ERRORS:
        return SpecularFit(highlights, np.zeros(count, dtype=np.float32), explained, errors, 0)
    mean = np.bincount(region, np.maximum(product, 0.0)) / np.maximum(np.bincount(region, power), 1e-12)
    strength = np.isin(region, shiny) * _smooth(power, product, mean[region], mesh)
    mixing = _mixing(mesh)
    for _ in range(REGION_SMOOTHING_STEPS):
        strength = mixing @ strength
    return SpecularFit(highlights, strength.astype(np.float32), explained, errors, len(shiny))


def _shiny_regions(
    region: Int[np.ndarray, "v"],
    tested: "_Regression",
    without: Float[np.ndarray, "k"],
    with_lobe: Float[np.ndarray, "k"],
) -> Int[np.ndarray, "s"]:
    """Return the regions whose colours in validation frames highlights predict; errors: squared, one a row."""
    scores = [
        tested.decrease(without, with_lobe, region[tested.vertex] == label) for label in range(int(region.max()) + 1)
    ]
    return np.flatnonzero([share > MIN_EXPLAINED and errors > MIN_REGION_STANDARD_ERRORS for share, errors in scores])


def find_lobe(fitted: "_Regression", light: VideoLight, vertex_count: int) -> Highlights:
    """Return the direction and the exponent that explain most of the training views.

    The key light is the lamp where its shadows are known; otherwise directions are tried within `MAX_LAMP_ANGLE_RAD` of
    that from which most light comes: errors of normals look like highlights of lamps that give no light.
    """
    directions = light.key_direction[None]
    if not light.casts_shadows:
        directions = search_directions()
        directions = directions[directions @ light.dominant_direction() > np.cos(MAX_LAMP_ANGLE_RAD)]
    candidates = [Highlights(direction, exponent) for direction in directions for exponent in EXPONENTS]
    best = max(candidates, key=lambda each: fitted.explained(each, vertex_count))
    for angle_rad in () if light.casts_shadows else SEARCH_REFINEMENTS_RAD:
        near = directions_around(best.direction, angle_rad)
        near = near[near @ light.dominant_direction() > np.cos(MAX_LAMP_ANGLE_RAD)]
        around = [replace(best, direction=each) for each in near]
        best = max([best, *around], key=lambda each: fitted.explained(each, vertex_count))
    sharper = [replace(best, exponent=exponent) for exponent in EXPONENTS]
    return max(sharper, key=lambda each: fitted.explained(each, vertex_count))


@dataclass(frozen=True)
class _Regression:
    """Rows of the model equation of the module docstring.

    Attributes:
        vertex, view: of each row.
        linear: y. irradiance: E. visibility: v of the key light.
        normal, to_camera: unit, world.
        weight: inverse variance of `linear`.
    """

    vertex: Int[np.ndarray, "k"]
    view: Int[np.ndarray, "k"]
    linear: Float[np.ndarray, "k 3"]
    irradiance: Float[np.ndarray, "k 3"]
    visibility: Float[np.ndarray, "k"]
    normal: Float[np.ndarray, "k 3"]
    to_camera: Float[np.ndarray, "k 3"]
    weight: Float[np.ndarray, "k"]

    @staticmethod
    def of_views(observed: ViewObservations, light: VideoLight) -> "_Regression":
        rows = observed.rows
        linear = srgb_to_linear(rows.colour.astype(np.float64)) / observed.gain[rows.frame, None]
        to_camera = np.zeros_like(linear)
        for number, view in enumerate(observed.views):
            here = rows.frame == number
            to_camera[here] = view.camera.centre_m() - view.vertices_world.numpy()[rows.vertex[here]]
        to_camera /= np.maximum(np.linalg.norm(to_camera, axis=1, keepdims=True), 1e-9)
        irradiance = light.irradiance(rows.normal, observed.visibility).astype(np.float64)
        weight = rows.weight / (linear.mean(axis=1) + MIN_LINEAR)
        return _Regression(
            rows.vertex, rows.frame, linear, irradiance, observed.visibility, rows.normal, to_camera, weight
        )

    def weighted(self, factor: np.ndarray) -> "_Regression":
        return replace(self, weight=self.weight * factor)

    def lobe(self, highlights: Highlights) -> np.ndarray:
        return highlights.lobe(self.normal, self.to_camera, self.visibility)

    def albedo(self, count: int, highlight: np.ndarray | float) -> Float[np.ndarray, "v 3"]:
        """Return the linear albedo of each vertex under known highlights (one a row)."""
        diffuse = self.linear - np.reshape(highlight, (-1, 1))
        above, below = (
            np.stack([np.bincount(self.vertex, self.weight * c, count) for c in (self.irradiance * each).T], axis=1)
            for each in (diffuse, self.irradiance)
        )
        return np.maximum(above / np.maximum(below, 1e-12), 0.0)

    def _eliminated(self, values: np.ndarray, count: int) -> np.ndarray:
        """Return what is left of one value a row after the best multiple of E at each vertex."""
        shading = self.irradiance.mean(axis=1)
        above = np.bincount(self.vertex, self.weight * shading * values, count)
        below = np.bincount(self.vertex, self.weight * shading**2, count)
        return values - (above / np.maximum(below, 1e-12))[self.vertex] * shading

    def normal_equations(self, highlights: Highlights, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the power of the lobe at each vertex, and its products with the three channels."""
        lobe = self._eliminated(self.lobe(highlights), count)
        power = np.bincount(self.vertex, self.weight * lobe**2, count)
        return power, np.stack(
            [np.bincount(self.vertex, self.weight * lobe * channel, count) for channel in self.linear.T], axis=1
        )

    def explained(self, highlights: Highlights, count: int) -> float:
        """Return by how much grey highlights of strength >= 0 reduce the weighted squared error."""
        power, products = self.normal_equations(highlights, count)
        product = np.maximum(products.min(axis=1), 0.0)
        return float(np.sum(product**2 / (power + _ridge(power))))

    def squared_errors(
        self, highlights: Highlights, strength: np.ndarray, albedo: np.ndarray
    ) -> Float[np.ndarray, "k"]:
        """Return the weighted squared error of each row."""
        predicted = albedo[self.vertex] * self.irradiance + (strength[self.vertex] * self.lobe(highlights))[:, None]
        known = albedo.any(axis=1)[self.vertex]
        return np.asarray(self.weight * known * np.sum((self.linear - predicted) ** 2, axis=1))

    def decrease(
        self, before: Float[np.ndarray, "k"], after: Float[np.ndarray, "k"], rows: Bool[np.ndarray, "k"]
    ) -> tuple[float, float]:
        """Return by which share an error falls in some rows, and the decrease a view in standard errors."""
        view, before, after = self.view[rows], before[rows], after[rows]
        seen = np.bincount(view, minlength=1) >= MIN_ROWS
        fall = np.bincount(view, before - after, minlength=1)[seen].astype(np.float64)
        return 1.0 - float(after.sum() / max(float(before.sum()), 1e-12)), standard_errors(fall)


def dielectric_specular_factor(
    strength: Float[np.ndarray, "*n"], roughness: float, lamp_irradiance: float
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


def _ridge(power: np.ndarray) -> float:
    """Return the regularisation of s: a fraction of the power at well-observed vertices of uniform albedo."""
    return max(RIDGE_FRACTION * float(np.quantile(power, 0.95)), 1e-12)


def _smooth(power: np.ndarray, product: np.ndarray, prior: np.ndarray, mesh: Mesh) -> Float[np.ndarray, "v"]:
    """Return s >= 0: power and product are pooled over the neighbourhood; s is the prior's where the lobe is weak."""
    ridge, mixing = _ridge(power), _mixing(mesh)
    for _ in range(SMOOTHING_STEPS):
        power, product = mixing @ power, mixing @ product
    return np.clip((np.maximum(product, 0.0) + ridge * prior) / (power + ridge), 0.0, 1.0)


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
