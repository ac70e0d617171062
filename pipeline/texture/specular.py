"""Separate specular highlights from diffuse shading in the video: the specular map.

Notation: c residual colour of a vertex in a frame (observation minus the mean over frames), a mean colour of the
vertex, n world normal, r world reflection direction of the view. Camera and lights are static while the person turns:
    c = a * (E(n) - mean E) + s * (L(r) - mean L),
where E (diffuse shading, scales the colour) and L (specular lobe, adds light) are shared by all vertices and expanded
in spherical harmonics without the constant term, and s >= 0 is the specular strength of each vertex. This is the split
of nerf2mesh into diffuse colour and specular features (Tang et al., "Delicate textured mesh recovery from NeRF", 2023)
with a linear lobe instead of a network, so that alternating least squares solves it. s is grey, because dielectrics
reflect light without colouring it. The split is kept only if it reduces the error on validation frames; otherwise the
surface is matte.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from pipeline.geometry.atlas import Texels
from pipeline.geometry.colour import srgb_to_linear
from pipeline.geometry.mesh import area_weighted_vertex_normals
from pipeline.texture.bake import TexturedSurface, sample_frame_colours
from pipeline.texture.settings import TextureSettings
from pipeline.texture.views import BakeView

ALTERNATING_LEAST_SQUARES_ITERATIONS = 8
RIDGE_WEIGHT = 1e-3
ALBEDO_CONTRAST_SCALE = 0.05
TINT_PENALTY = 4.0


@dataclass(frozen=True)
class VertexObservations:
    """Observed vertices, one row per vertex and frame.

    Attributes:
        vertex: index of the vertex.
        colour: sRGB in [0, 1].
        weight: of the observation, > 0.
        normal: unit vertex normal, world.
        reflection_direction: view direction mirrored at the normal, unit, world.
    """

    vertex: Int[np.ndarray, "k"]
    colour: Float[np.ndarray, "k 3"]
    weight: Float[np.ndarray, "k"]
    normal: Float[np.ndarray, "k 3"]
    reflection_direction: Float[np.ndarray, "k 3"]


@dataclass(frozen=True)
class SpecularFit:
    """Result of the specular fit.

    Attributes:
        amplitude: what a highlight adds to the colour of a vertex, sRGB in [0, 1]; all 0 if `partial_r2` is too small.
        partial_r2: fraction of the squared validation error after diffuse shading that highlights explain; at most 1,
            negative if they increase the error.
    """

    amplitude: Float[np.ndarray, "v"]
    partial_r2: float


def texels_at_vertices(faces: Int[np.ndarray, "f 3"], vertex_count: int) -> Texels:
    """Return one "texel" at each vertex that has a face, so that vertices are sampled like texels.

    The column of each texel is its vertex index.
    """
    corners = faces.reshape(-1)
    vertices, first = np.unique(corners, return_index=True)
    barycentric = np.eye(3, dtype=np.float32)[first % 3]
    zeros = np.zeros(len(vertices), dtype=np.int32)
    return Texels(vertex_count, zeros, vertices.astype(np.int32), (first // 3).astype(np.int32), barycentric)


def observe_vertices(
    views: Iterable[BakeView], surface: TexturedSurface, settings: TextureSettings
) -> VertexObservations:
    """Sample the colours of all vertices in all views that show them.

    surface: its `texels` must come from `texels_at_vertices`.
    """
    parts = []
    vertices = surface.texels.columns
    for view in views:
        colour, weight = sample_frame_colours(view, surface, settings)
        visible = (weight > 0).numpy()
        normal = area_weighted_vertex_normals(view.vertices_world, surface.faces).numpy()[vertices[visible]]
        to_camera = view.camera.centre_m() - view.vertices_world.numpy()[vertices[visible]]
        to_camera /= np.linalg.norm(to_camera, axis=1, keepdims=True)
        reflection_direction = 2.0 * np.sum(normal * to_camera, axis=1, keepdims=True) * normal - to_camera
        parts.append(
            (
                vertices[visible],
                colour.numpy()[visible],
                weight.numpy()[visible],
                normal,
                reflection_direction.astype(np.float32),
            )
        )
    return VertexObservations(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def real_spherical_harmonics(directions: Float[np.ndarray, "k 3"], degree: int) -> Float[np.ndarray, "k m"]:
    """Evaluate real spherical harmonics up to a degree without the constant; m = 8 for degree 2, 15 for degree 3.

    The functions are orthogonal, not normalised. Degree 2 holds 99 % of the energy of diffuse shading (Ramamoorthi and
    Hanrahan, "An efficient representation for irradiance environment maps", 2001).

    directions: unit vectors. degree: 2 or 3.
    """
    x, y, z = directions.T
    terms = [x, y, z, x * y, y * z, 3.0 * z * z - 1.0, x * z, x * x - y * y]
    if degree >= 3:
        terms += [
            y * (3.0 * x * x - y * y),
            x * y * z,
            y * (5.0 * z * z - 1.0),
            z * (5.0 * z * z - 3.0),
            x * (5.0 * z * z - 1.0),
            z * (x * x - y * y),
            x * (x * x - 3.0 * y * y),
        ]
    return np.stack(terms, axis=1)


@dataclass(frozen=True)
class _RegressionTerms:
    """Left and right side of the regression for a set of observations, centred per vertex."""

    residual: Float[np.ndarray, "k 3"]
    shading_basis: Float[np.ndarray, "k 8"]
    lobe_basis: Float[np.ndarray, "k 15"]


class _CentredModel:
    """Makes regression terms relative to the weighted means of each vertex over the training frames."""

    def __init__(self, train: VertexObservations, vertex_count: int) -> None:
        self.albedo = _vertex_means(train, train.colour, vertex_count)
        self._shading_mean = _vertex_means(train, real_spherical_harmonics(train.normal, 2), vertex_count)
        self._lobe_mean = _vertex_means(train, real_spherical_harmonics(train.reflection_direction, 3), vertex_count)

    def terms(self, observations: VertexObservations) -> _RegressionTerms:
        vertex = observations.vertex
        return _RegressionTerms(
            observations.colour - self.albedo[vertex],
            real_spherical_harmonics(observations.normal, 2) - self._shading_mean[vertex],
            real_spherical_harmonics(observations.reflection_direction, 3) - self._lobe_mean[vertex],
        )


@dataclass(frozen=True)
class _SpecularModel:
    """Solved coefficients: E and L of the module docstring, and s of each vertex."""

    shading_coefficients: Float[np.ndarray, "8"]
    lobe_coefficients: Float[np.ndarray, "15"]
    strength: Float[np.ndarray, "v"]


def fit_specular(
    train: VertexObservations,
    validation: VertexObservations,
    edges: Int[np.ndarray, "e 2"],
    vertex_count: int,
    min_partial_r2: float,
) -> SpecularFit:
    """Fit diffuse shading and highlights to training frames and test them on validation frames.

    A wrong pose changes the colour of a vertex with the view as a highlight does, and this generalises to other frames:
    on a real recording the hem of a shirt and a print were the strongest "highlights". Only colourless changes on
    surface parts of uniform albedo are therefore used.

    edges: of the mesh. min_partial_r2: smallest `SpecularFit.partial_r2` at which highlights are kept.
    """
    model = _CentredModel(train, vertex_count)
    uniformity = albedo_uniformity(model.albedo, edges)
    train = replace(train, weight=(train.weight * uniformity[train.vertex]).astype(np.float32))
    validation = replace(validation, weight=(validation.weight * uniformity[validation.vertex]).astype(np.float32))
    solved = _alternate_least_squares(train, model.terms(train), model.albedo, vertex_count)
    partial_r2 = _partial_r2(model.terms(validation), validation, model.albedo, solved)
    lobe_range = np.ptp(
        np.percentile(real_spherical_harmonics(train.reflection_direction, 3) @ solved.lobe_coefficients, [1.0, 99.0])
    )
    is_specular = partial_r2 >= min_partial_r2
    amplitude = np.clip(solved.strength * lobe_range, 0.0, 1.0) if is_specular else np.zeros(vertex_count)
    return SpecularFit(amplitude.astype(np.float32), float(partial_r2))


def dielectric_specular_factor(
    amplitude: Float[np.ndarray, "*n"], base: Float[np.ndarray, "*n 3"], roughness: float
) -> Float[np.ndarray, "*n"]:
    """Return glTF's specular factor, in [0, 1], of a dielectric that shows highlights of this amplitude.

    glTF's microfacet model (specification, appendix B; alpha = roughness^2) reflects 4 % of the light along the normal.
    At the peak of a highlight, where D = 1 / (pi alpha^2) and V = 1/4, the added radiance is
    pi * 0.04 * D * V = 0.01 / alpha^2 under a light that renders a white diffuse surface as 1. The real lights are
    unknown: such a light is assumed. The factor is clipped at 1, since few dielectrics reflect more.

    Args:
        amplitude: added to `base`, sRGB in [0, 1].
        base: diffuse colour, sRGB in [0, 1].
        roughness: glTF's, in [0, 1].
    """
    added = (srgb_to_linear(base + amplitude[..., None]) - srgb_to_linear(base)).mean(axis=-1)
    return np.clip(added * roughness**4 / 0.01, 0.0, 1.0)


def albedo_uniformity(albedo: Float[np.ndarray, "v 3"], edges: Int[np.ndarray, "e 2"]) -> Float[np.ndarray, "v"]:
    """Return how uniform the albedo is around each vertex, in (0, 1].

    1 where all neighbours have the same colour; 1/4 where the largest difference of a channel is
    `ALBEDO_CONTRAST_SCALE` (Geman-McClure weight).
    """
    difference = np.abs(albedo[edges[:, 0]] - albedo[edges[:, 1]]).max(axis=1)
    largest = np.zeros(len(albedo))
    np.maximum.at(largest, edges.ravel(), np.repeat(difference, 2))
    return 1.0 / (1.0 + (largest / ALBEDO_CONTRAST_SCALE) ** 2) ** 2


def _vertex_means(train: VertexObservations, values: np.ndarray, vertex_count: int) -> np.ndarray:
    """Return the weighted mean of the columns of `values` at each vertex; 0 without observations."""
    total = np.maximum(np.bincount(train.vertex, train.weight, vertex_count), 1e-9)
    columns = [np.bincount(train.vertex, train.weight * column, vertex_count) for column in values.T]
    return np.stack(columns, axis=1) / total[:, None]


def _alternate_least_squares(
    train: VertexObservations, terms: _RegressionTerms, albedo: np.ndarray, vertex_count: int
) -> _SpecularModel:
    """Solve for E, L and s in turn."""
    vertex = train.vertex
    highlights = np.zeros_like(terms.residual)
    strength = np.ones(vertex_count)
    for _ in range(ALTERNATING_LEAST_SQUARES_ITERATIONS):
        shading_coefficients = _solve_shared_coefficients(
            terms.shading_basis, albedo[vertex], terms.residual - highlights, train.weight
        )
        unexplained = terms.residual - (terms.shading_basis @ shading_coefficients)[:, None] * albedo[vertex]
        strength_per_channel = np.repeat(strength[vertex, None], 3, axis=1)
        lobe_coefficients = _solve_shared_coefficients(
            terms.lobe_basis, strength_per_channel, unexplained, train.weight
        )
        # Fix the scale of L: otherwise the ridge term shrinks s and L grows to compensate, in every iteration.
        lobe_coefficients /= max(
            float(np.sqrt(np.average((terms.lobe_basis @ lobe_coefficients) ** 2, weights=train.weight))), 1e-9
        )
        lobe_value = terms.lobe_basis @ lobe_coefficients
        strength = _solve_vertex_strengths(train, lobe_value, unexplained, vertex_count)
        highlights = np.repeat((lobe_value * strength[vertex])[:, None], 3, axis=1)
    return _SpecularModel(shading_coefficients, lobe_coefficients, strength)


def _solve_shared_coefficients(
    basis: np.ndarray, scale: np.ndarray, target: np.ndarray, weight: np.ndarray
) -> Float[np.ndarray, "m"]:
    """Return the coefficients x that minimise sum w |scale * (basis x) - target|^2, with a ridge term."""
    power = weight * np.sum(scale**2, axis=1)
    matrix = (basis * power[:, None]).T @ basis
    right_hand_side = basis.T @ (weight * np.sum(scale * target, axis=1))
    ridge = RIDGE_WEIGHT * np.trace(matrix) / len(matrix) * np.eye(len(matrix))
    return np.linalg.solve(matrix + ridge, right_hand_side)


def _solve_vertex_strengths(
    train: VertexObservations, lobe_value: np.ndarray, unexplained: np.ndarray, vertex_count: int
) -> Float[np.ndarray, "v"]:
    """Return s >= 0 of each vertex for a fixed lobe.

    A ridge term and a tint penalty shrink s where observations are few, the lobe is weak, or the change is coloured.
    """
    power = np.bincount(train.vertex, train.weight * lobe_value**2, vertex_count)
    right_hand_side = np.stack(
        [np.bincount(train.vertex, train.weight * lobe_value * c, vertex_count) for c in unexplained.T], axis=1
    )
    ridge = np.median(power[power > 0]) if np.any(power > 0) else 1.0
    channels = right_hand_side / (power + ridge)[:, None]
    mean_strength = np.maximum(channels.mean(axis=1), 0.0)
    tint = np.sum((channels - mean_strength[:, None]) ** 2, axis=1)
    return mean_strength**3 / np.maximum(mean_strength**2 + TINT_PENALTY * tint, 1e-12)


def _partial_r2(
    terms: _RegressionTerms, observations: VertexObservations, albedo: np.ndarray, solved: _SpecularModel
) -> float:
    vertex, weight = observations.vertex, observations.weight[:, None]
    unexplained = terms.residual - (terms.shading_basis @ solved.shading_coefficients)[:, None] * albedo[vertex]
    remaining = unexplained - (terms.lobe_basis @ solved.lobe_coefficients * solved.strength[vertex])[:, None]
    before = float(np.sum(weight * unexplained**2))
    return 1.0 - float(np.sum(weight * remaining**2)) / before if before > 0 else 0.0
