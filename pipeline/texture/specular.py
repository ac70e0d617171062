"""Highlights that move over the surface, told apart from shading: the specular map.

Letters: c residual colour of a vertex in a frame (observed minus the vertex's mean over frames), a its mean colour,
n world normal, r world direction of the mirrored view. Camera and light stand still while the person turns, so
    c = a · (E(n) - mean E) + s · (L(r) - mean L),
with E (shading, scales the colour) and L (highlight, adds light) shared by all vertices as spherical harmonics without
their constant, and s >= 0 each vertex's specular strength: nerf2mesh's split into diffuse colour and specular features
(Tang et al. 2023) with a linear lobe instead of a network, so that it is solved and not trained. s is grey, because
what is neither metal nor lacquer reflects light without colouring it. The split counts only if it foretells frames that
it has not seen; else the surface is matte.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from pipeline.geometry.atlas import Texels
from pipeline.geometry.camera import pixel_footprint_m
from pipeline.geometry.colour import srgb_to_linear
from pipeline.geometry.mesh import area_weighted_vertex_normals
from pipeline.texture.bake import BakeConfig, TexturedSurface, observe
from pipeline.texture.views import BakeView, pixel_confidence, render_depth

ALTERNATING_LEAST_SQUARES_ITERATIONS = 8
RIDGE_WEIGHT = 1e-3
ALBEDO_CONTRAST_SCALE = 0.05
TINT_PENALTY = 4.0


@dataclass(frozen=True)
class VertexObservations:
    """What frames show of vertices, a row an observation: vertex, colour, weight, normal and mirrored view (world)."""

    vertex: Int[np.ndarray, "k"]
    colour: Float[np.ndarray, "k 3"]
    weight: Float[np.ndarray, "k"]
    normal: Float[np.ndarray, "k 3"]
    reflection_direction: Float[np.ndarray, "k 3"]


@dataclass(frozen=True)
class SpecularFit:
    """amplitude: what a highlight adds to a vertex's colour, sRGB in [0, 1]; 0 everywhere when that explains nothing.

    gain: share of the error on unseen frames that the highlights explain beyond shading (negative: they mislead).
    """

    amplitude: Float[np.ndarray, "v"]
    partial_r2: float


def texels_at_vertices(faces: Int[np.ndarray, "f 3"], vertex_count: int) -> Texels:
    """One "texel" a vertex, so that vertices can be observed as texels are; vertices without a face are left out."""
    flat = faces.reshape(-1)
    vertices, first = np.unique(flat, return_index=True)
    barycentric = np.eye(3, dtype=np.float32)[first % 3]
    zeros = np.zeros(len(vertices), dtype=np.int32)
    return Texels(vertex_count, zeros, vertices.astype(np.int32), (first // 3).astype(np.int32), barycentric)


def observe_vertices(views: Iterable[BakeView], surface: TexturedSurface, config: BakeConfig) -> VertexObservations:
    """Colours of all vertices in all views where they can be seen. `surface.texels` must come from
    `texels_at_vertices`.
    """
    parts = []
    vertices = surface.texels.columns
    for view in views:
        depth_m = render_depth(view, surface.faces)
        pixel_weights = pixel_confidence(
            view.mask,
            depth_m.numpy(),
            config.silhouette_falloff_m / pixel_footprint_m(view.vertices_world, view.camera),
        )
        colour, weight = observe(view, surface, view.image.astype(np.float32) / 255.0, pixel_weights, depth_m, config)
        seen = (weight > 0).numpy()
        normal = area_weighted_vertex_normals(view.vertices_world, surface.faces).numpy()[vertices[seen]]
        to_camera = view.camera.centre_m() - view.vertices_world.numpy()[vertices[seen]]
        to_camera /= np.linalg.norm(to_camera, axis=1, keepdims=True)
        reflection_direction = 2.0 * np.sum(normal * to_camera, axis=1, keepdims=True) * normal - to_camera
        parts.append(
            (
                vertices[seen],
                colour.numpy()[seen],
                weight.numpy()[seen],
                normal,
                reflection_direction.astype(np.float32),
            )
        )
    return VertexObservations(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def real_spherical_harmonics(directions: Float[np.ndarray, "k 3"], degree: int) -> Float[np.ndarray, "k m"]:
    """Real spherical harmonics up to a degree (2 or 3) without the constant, not normalised.

    (Ramamoorthi and Hanrahan 2001 show that degree 2 holds 99 % of diffuse shading.)
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


class _VertexMeans:
    """Observations relative to their vertex's weighted mean over the training frames."""

    def __init__(self, train: VertexObservations, count: int) -> None:
        self.count = count
        self.total = np.maximum(np.bincount(train.vertex, train.weight, count), 1e-9)
        self.mean_colour = self.mean(train, train.colour)

    def mean(self, train: VertexObservations, values: np.ndarray) -> np.ndarray:
        columns = [np.bincount(train.vertex, train.weight * column, self.count) for column in values.T]
        return np.stack(columns, axis=1) / self.total[:, None]


def fit_specular(
    train: VertexObservations,
    validation: VertexObservations,
    edges: Int[np.ndarray, "e 2"],
    count: int,
    min_partial_r2: float,
) -> SpecularFit:
    """Shading and highlights from training frames, judged on validation frames.

    edges: of the mesh; count: number of vertices. least_gain: share of the validation error that highlights must
    explain to be kept.

    A wrong pose changes a vertex's colour with the view as a highlight does, and foretells other frames as well: on a
    real video the hem of a shirt and a print came out as the brightest highlights. So only changes count that light
    reflected at a surface can make, colourless ones, and only where the paint around is flat.
    """
    centred = _VertexMeans(train, count)
    shading_basis_mean = centred.mean(train, real_spherical_harmonics(train.normal, 2))
    lobe_basis_mean = centred.mean(train, real_spherical_harmonics(train.reflection_direction, 3))
    albedo = centred.mean_colour
    flat = albedo_uniformity(albedo, edges)
    train = replace(train, weight=(train.weight * flat[train.vertex]).astype(np.float32))
    validation = replace(validation, weight=(validation.weight * flat[validation.vertex]).astype(np.float32))

    def terms(seen: VertexObservations) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        residual = seen.colour - albedo[seen.vertex]
        shading_basis = real_spherical_harmonics(seen.normal, 2) - shading_basis_mean[seen.vertex]
        lobe_basis = real_spherical_harmonics(seen.reflection_direction, 3) - lobe_basis_mean[seen.vertex]
        return residual, shading_basis, lobe_basis

    residual, shading_basis, lobe_basis = terms(train)
    highlights = np.zeros_like(residual)
    strength = np.ones(count)
    for _ in range(ALTERNATING_LEAST_SQUARES_ITERATIONS):
        shading_coefficients = _solve_shared_coefficients(
            shading_basis, albedo[train.vertex], residual - highlights, train.weight
        )
        unexplained = residual - (shading_basis @ shading_coefficients)[:, None] * albedo[train.vertex]
        grey = np.repeat(strength[train.vertex, None], 3, axis=1)
        lobe_coefficients = _solve_shared_coefficients(lobe_basis, grey, unexplained, train.weight)
        # without a fixed size of L the ridge would pull s down and L would grow in its place, round after round
        lobe_coefficients /= max(
            float(np.sqrt(np.average((lobe_basis @ lobe_coefficients) ** 2, weights=train.weight))), 1e-9
        )
        lobe_value = lobe_basis @ lobe_coefficients
        strength = _solve_vertex_strengths(train, lobe_value, unexplained, count)
        highlights = np.repeat((lobe_value * strength[train.vertex])[:, None], 3, axis=1)
    partial_r2 = _partial_r2(terms(validation), validation, albedo, shading_coefficients, lobe_coefficients, strength)
    lobe_range = np.ptp(
        np.percentile(real_spherical_harmonics(train.reflection_direction, 3) @ lobe_coefficients, [1.0, 99.0])
    )
    kept = np.clip(strength * lobe_range, 0.0, 1.0) if partial_r2 >= min_partial_r2 else np.zeros(count)
    return SpecularFit(kept.astype(np.float32), float(partial_r2))


def dielectric_specular_factor(
    amplitude: Float[np.ndarray, "*n"], base: Float[np.ndarray, "*n 3"], roughness: float
) -> Float[np.ndarray, "*n"]:
    """How much of a dielectric's reflection shows highlights of this amplitude, in [0, 1]: glTF's specular factor.

    glTF's microfacet model (specification, appendix B; α = roughness²) reflects 4 % of the light along the normal. At a
    highlight's peak, where D = 1 / (π α²) and V = 1/4, that adds π · 0.04 · D · V = 0.01 / α² where the same lamp shows
    white paint as 1. What the lamps were is unknown: one that shows white paint as 1 is taken. 1 stands for all that is
    brighter as well, since no other dielectric reflects much more.

    amplitude: on top of `base`, both sRGB in [0, 1]. roughness: glTF's, in [0, 1].
    """
    added = (srgb_to_linear(base + amplitude[..., None]) - srgb_to_linear(base)).mean(axis=-1)
    return np.clip(added * roughness**4 / 0.01, 0.0, 1.0)


def albedo_uniformity(albedo: Float[np.ndarray, "v 3"], edges: Int[np.ndarray, "e 2"]) -> Float[np.ndarray, "v"]:
    """1 where a vertex has its neighbours' colour, towards 0 where they differ by more than `ALBEDO_CONTRAST_SCALE`."""
    step = np.abs(albedo[edges[:, 0]] - albedo[edges[:, 1]]).max(axis=1)
    largest = np.zeros(len(albedo))
    np.maximum.at(largest, edges.ravel(), np.repeat(step, 2))
    return 1.0 / (1.0 + (largest / ALBEDO_CONTRAST_SCALE) ** 2) ** 2


def _solve_shared_coefficients(
    basis: np.ndarray, scale: np.ndarray, target: np.ndarray, weight: np.ndarray
) -> Float[np.ndarray, "m"]:
    """Coefficients x that minimise sum w |scale · (basis x) - target|^2."""
    power = weight * np.sum(scale**2, axis=1)
    matrix = (basis * power[:, None]).T @ basis
    right = basis.T @ (weight * np.sum(scale * target, axis=1))
    return np.linalg.solve(matrix + RIDGE_WEIGHT * np.trace(matrix) / len(matrix) * np.eye(len(matrix)), right)


def _solve_vertex_strengths(
    train: VertexObservations, lobe_value: np.ndarray, unexplained: np.ndarray, count: int
) -> Float[np.ndarray, "v"]:
    """Each vertex's s >= 0 for given highlights: near 0 where few or weak ones were seen, or coloured ones."""
    power = np.bincount(train.vertex, train.weight * lobe_value**2, count)
    right_hand_side = np.stack(
        [np.bincount(train.vertex, train.weight * lobe_value * c, count) for c in unexplained.T], axis=1
    )
    ridge = np.median(power[power > 0]) if np.any(power > 0) else 1.0
    channels = right_hand_side / (power + ridge)[:, None]
    grey = np.maximum(channels.mean(axis=1), 0.0)
    tint = np.sum((channels - grey[:, None]) ** 2, axis=1)
    return grey**3 / np.maximum(grey**2 + TINT_PENALTY * tint, 1e-12)


def _partial_r2(
    terms: tuple[np.ndarray, np.ndarray, np.ndarray],
    seen: VertexObservations,
    albedo: np.ndarray,
    shading_coefficients: np.ndarray,
    lobe_coefficients: np.ndarray,
    strength: np.ndarray,
) -> float:
    residual, shading_basis, lobe_basis = terms
    unexplained = residual - (shading_basis @ shading_coefficients)[:, None] * albedo[seen.vertex]
    left = unexplained - (lobe_basis @ lobe_coefficients * strength[seen.vertex])[:, None]
    before = float(np.sum(seen.weight[:, None] * unexplained**2))
    return 1.0 - float(np.sum(seen.weight[:, None] * left**2)) / before if before > 0 else 0.0
