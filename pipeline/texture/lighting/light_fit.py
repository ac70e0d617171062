"""Estimate the light of a video from the colours of the mesh's vertices over the turn.

The logarithm of a linear colour is log albedo (vertex) + log E (normal, shadow) + log gain (frame). Gauss-Newton steps
minimise the robust (Cauchy) error of all three. A step is linear, sparse in the albedos and dense in some hundred other
unknowns, so the albedos are eliminated (variable projection: Golub and Pereyra, 1973). A turn about the vertical hardly
tells how the light changes with height, because it keeps the height of a normal: neighbouring vertices of equal colour
tell it, by a prior that their albedos are equal, robust against edges of the albedo (Retinex: Land and McCann, 1971).
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array, csc_array, diags_array

from pipeline.geometry.colour import srgb_to_linear
from pipeline.geometry.linear_systems import factorise_positive_definite
from pipeline.geometry.mesh import area_weighted_vertex_normals
from pipeline.kernels.common.thread_pool import shared_thread_pool
from pipeline.texture.bake import TexturedSurface, sample_frame_colours
from pipeline.texture.light import MIN_IRRADIANCE, VideoLight, key_visibility, spherical_harmonics
from pipeline.texture.settings import TextureSettings
from pipeline.texture.views import BakeView

MIN_COLOUR, MAX_COLOUR = 0.04, 0.97
"""sRGB; a darker channel is noise in the logarithm, a brighter one is clipped."""

GAUSS_NEWTON_STEPS = 8
BASIS_SIZE = 9
MAX_STEP = 0.7
"""Of log albedo, log gain or a coefficient in one Gauss-Newton step."""

ALBEDO_SMOOTHNESS = 0.05
"""Weight of the difference of two neighbours' log albedos, relative to the median weight of a vertex's observations."""

ALBEDO_EDGE = 0.08
"""Difference of two log albedos at which the robust prior has a quarter of its weight."""

DAMPING, GAUGE_WEIGHT = 1e-3, 1e3
"""Weights that keep a step small, of all unknowns and of the constant terms, whose scale is that of the albedo."""

GAIN_PRIOR, SHAPE_PRIOR, COLOUR_PRIOR = 0.1, 0.1, 1.0
"""Weights of unit gains, of coefficients of degree 1 and 2 that are 0, and of those that are equal in all channels,
each against an error relative to the noise in all observations of a frame. Few frames show normals that point up or
down: without these priors wrong poses of the head decide their irradiance and its colour."""

MAX_ERROR = 0.7
"""Error of a logarithm from which on an observation shows another surface; a fully shadowed one has less."""

MIN_NOISE = 0.01
"""Smallest scale of the robust error, in the logarithm."""


@dataclass(frozen=True)
class LightObservations:
    """Vertices seen in frames, one row per vertex and frame.

    Attributes:
        frame: index of the view. vertex: index of the vertex.
        colour: sRGB in [0, 1], between `MIN_COLOUR` and `MAX_COLOUR`.
        weight: of the observation, > 0.
        normal: unit vertex normal, world.
    """

    frame: Int[np.ndarray, "k"]
    vertex: Int[np.ndarray, "k"]
    colour: Float[np.ndarray, "k 3"]
    weight: Float[np.ndarray, "k"]
    normal: Float[np.ndarray, "k 3"]

    def select(self, rows: Bool[np.ndarray, "k"]) -> "LightObservations":
        """Return some rows."""
        return LightObservations(*(getattr(self, field.name)[rows] for field in fields(LightObservations)))

    def log_linear(self) -> Float[np.ndarray, "k 3"]:
        """Return the logarithm of the linear colours."""
        return np.log(srgb_to_linear(self.colour.astype(np.float64)))

    def log_weight(self) -> Float[np.ndarray, "k"]:
        """Return the weight of an error of the logarithm: that of the error of the sRGB value which it makes."""
        return self.weight * self.colour.mean(axis=1).astype(np.float64) ** 2


@dataclass(frozen=True)
class ViewObservations:
    """What some views show of the vertices, with what is known of their light.

    Attributes:
        views: in order.
        rows: `rows.frame` counts `views`.
        visibility: of the key light, one per row, in [0, 1]; 1 without a key light.
        gain: exposure of each view.
    """

    views: Sequence[BakeView]
    rows: LightObservations
    visibility: Float[np.ndarray, "k"]
    gain: Float[np.ndarray, "n"]


@dataclass(frozen=True)
class LightFit:
    """Light and gains, and the albedo that was solved with them.

    Attributes:
        light: its `gain` has one entry per view.
        log_albedo: logarithm of the linear albedo of each vertex; 0 at vertices that no view shows.
    """

    light: VideoLight
    log_albedo: Float[np.ndarray, "v 3"]


def observe_light(views: Sequence[BakeView], surface: TexturedSurface, settings: TextureSettings) -> LightObservations:
    """Sample the colours of all vertices in all views that show them; surface: see `pipeline.texture.vertex_texels`."""
    vertices = surface.texels.columns

    def observe(number: int, view: BakeView) -> tuple[np.ndarray, ...]:
        colour, weight = (values.numpy() for values in sample_frame_colours(view, surface, settings))
        used = (weight > 0) & (colour.min(axis=1) > MIN_COLOUR) & (colour.max(axis=1) < MAX_COLOUR)
        normal = area_weighted_vertex_normals(view.vertices_world, surface.faces).numpy()[vertices[used]]
        frame = np.full(int(used.sum()), number)
        return frame, vertices[used].astype(np.int64), colour[used], weight[used], normal

    parts = shared_thread_pool(torch.get_num_threads()).map(observe, range(len(views)), views)
    return LightObservations(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def observe_visibility(
    views: Sequence[BakeView],
    faces: torch.Tensor,
    observed: LightObservations,
    key_direction: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "k"]:
    """Return which part of the light from a direction reaches each observed vertex, in [0, 1]."""

    def lit_vertices(view: BakeView) -> Float[np.ndarray, "v"]:
        normals = area_weighted_vertex_normals(view.vertices_world, faces)
        return key_visibility(view.vertices_world, faces, normals, key_direction).numpy()

    visibility = np.ones(len(observed.vertex))
    for number, seen in enumerate(shared_thread_pool(torch.get_num_threads()).map(lit_vertices, views)):
        rows = observed.frame == number
        visibility[rows] = seen[observed.vertex[rows]]
    return visibility


def vertex_mean(vertex: np.ndarray, values: np.ndarray, weight: np.ndarray, count: int) -> np.ndarray:
    """Return the weighted mean of one value a row at each vertex; 0 without rows."""
    total = np.maximum(np.bincount(vertex, weight, count), 1e-12)
    return np.bincount(vertex, weight * values, count) / total


def mean_log_albedo(
    observed: LightObservations,
    irradiance: Float[np.ndarray, "k 3"],
    gain: Float[np.ndarray, "n"],
    vertex_count: int,
) -> Float[np.ndarray, "v 3"]:
    """Return the weighted mean log albedo of each vertex under a light; 0 without observations."""
    shaded = observed.log_linear() - np.log(irradiance) - np.log(gain)[observed.frame, None]
    columns = [vertex_mean(observed.vertex, column, observed.log_weight(), vertex_count) for column in shaded.T]
    return np.stack(columns, axis=1)


@dataclass(frozen=True)
class Prediction:
    """How well light and albedo predict views that they were not fitted to.

    Attributes:
        squared_error: of the logarithm of linear colour in each view after its own gain; clipped at `MAX_ERROR`.
        log_gain: weighted median residual of each view.
    """

    squared_error: Float[np.ndarray, "n"]
    log_gain: Float[np.ndarray, "n"]


def predict_views(
    fit: LightFit, observed: LightObservations, visibility: Float[np.ndarray, "k"], view_count: int
) -> Prediction:
    """Compare the observations of views with a fit, at vertices that were fitted; visibility: of the key light."""
    is_fitted = fit.log_albedo.any(axis=1)[observed.vertex]
    irradiance = fit.light.irradiance(observed.normal, visibility)
    residual = observed.log_linear() - np.log(irradiance) - fit.log_albedo[observed.vertex]
    weight = observed.log_weight() * is_fitted
    errors, gains = np.zeros(view_count), np.zeros(view_count)
    for view in range(view_count):
        rows = np.flatnonzero((observed.frame == view) & is_fitted)
        if not len(rows):
            continue
        gains[view] = weighted_median(residual[rows].mean(axis=1), weight[rows])
        squared = np.minimum((residual[rows] - gains[view]) ** 2, MAX_ERROR**2).sum(axis=1)
        errors[view] = np.average(squared, weights=weight[rows])
    return Prediction(errors, gains)


def weighted_median(values: Float[np.ndarray, "n"], weight: Float[np.ndarray, "n"]) -> float:
    """Return the value below which half of the weight lies."""
    order = np.argsort(values)
    cumulative = np.cumsum(weight[order])
    return float(values[order[np.searchsorted(cumulative, 0.5 * cumulative[-1])]])


def fit_light(
    observed: LightObservations,
    edges: Int[np.ndarray, "e 2"],
    vertex_count: int,
    view_count: int,
    visibility: Float[np.ndarray, "k"] | None = None,
    start: LightFit | None = None,
) -> LightFit:
    """Solve for light, gains and albedos.

    Args:
        observed: of the training views.
        edges: of the mesh.
        vertex_count, view_count: sizes of the result.
        visibility: of the key light from `start.light.key_direction`, one per observation; None: no key light.
        start: result to start from; None: a uniform light.
    """
    problem = _Problem(observed, edges, vertex_count, view_count, visibility)
    fit = start or problem.uniform_light()
    for _ in range(GAUSS_NEWTON_STEPS):
        fit = problem.normalised(problem.step(fit))
    return fit


class _Problem:
    """The robust least-squares problem of one set of observations."""

    def __init__(
        self,
        observed: LightObservations,
        edges: np.ndarray,
        vertex_count: int,
        view_count: int,
        visibility: np.ndarray | None,
    ) -> None:
        self.observed, self.edges, self.visibility = observed, edges, visibility
        self.vertex_count, self.view_count = vertex_count, view_count
        self.target = observed.log_linear()
        self.basis = spherical_harmonics(observed.normal)
        self.weight = observed.log_weight()

    def uniform_light(self) -> LightFit:
        light = VideoLight.uniform(self.view_count)
        return LightFit(light, mean_log_albedo(self.observed, self._irradiance(light), light.gain, self.vertex_count))

    def _lambert(self, light: VideoLight) -> np.ndarray | None:
        if self.visibility is None:
            return None
        return self.visibility * np.maximum(self.observed.normal @ light.key_direction, 0.0)

    def _irradiance(self, light: VideoLight) -> np.ndarray:
        smooth, lambert = self.basis @ light.coefficients, self._lambert(light)
        key = 0.0 if lambert is None else lambert[:, None] * light.key_irradiance
        return np.maximum(smooth + key, MIN_IRRADIANCE)

    def residual(self, fit: LightFit) -> Float[np.ndarray, "k 3"]:
        predicted = fit.log_albedo[self.observed.vertex] + np.log(self._irradiance(fit.light))
        return self.target - predicted - np.log(fit.light.gain)[self.observed.frame, None]

    def normalised(self, fit: LightFit) -> LightFit:
        """Move the free scales: the mean log gain is 0, and the mean log irradiance of the observations."""
        light = fit.light
        log_gain = float(np.log(light.gain).mean())
        log_scale = np.average(np.log(self._irradiance(light)), axis=0, weights=self.weight)
        scaled = replace(
            light,
            coefficients=light.coefficients / np.exp(log_scale),
            key_irradiance=light.key_irradiance / np.exp(log_scale),
            gain=light.gain / np.exp(log_gain),
        )
        return LightFit(scaled, fit.log_albedo + log_scale + log_gain)

    def step(self, fit: LightFit) -> LightFit:
        """Return the fit after one Gauss-Newton step."""
        light, vertex, frame = fit.light, self.observed.vertex, self.observed.frame
        residual = self.residual(fit)
        length = np.linalg.norm(residual, axis=1)
        noise = max(1.4826 * float(np.median(length)), MIN_NOISE)
        weight = self.weight / (1.0 + (length / noise) ** 2)
        irradiance, basis = self._irradiance(light), self._light_basis(light)
        albedo_matrix, smoothness = self._albedo_matrix(weight, fit.log_albedo)
        factor = factorise_positive_definite(albedo_matrix)
        frames, terms = self.view_count, basis.shape[1]
        system = np.zeros((frames + 3 * terms, frames + 3 * terms + 1))
        per_frame = coo_array((weight, (vertex, frame)), shape=(self.vertex_count, frames)).toarray()
        solved_per_frame = factor.solve(per_frame)
        solutions = []
        for channel in range(3):
            jacobian = basis / irradiance[:, channel, None]
            jacobian[irradiance[:, channel] <= MIN_IRRADIANCE] = 0.0
            per_vertex, block = self._channel_blocks(jacobian, weight)
            coupling = np.concatenate([per_frame, per_vertex], axis=1)
            error = weight * residual[:, channel]
            albedo_right = np.bincount(vertex, error, self.vertex_count) - smoothness @ fit.log_albedo[:, channel]
            right = np.concatenate([np.bincount(frame, error, frames), jacobian.T @ error])
            solved = np.concatenate(
                [solved_per_frame, factor.solve(np.column_stack([per_vertex, albedo_right]))], axis=1
            )
            rows = np.r_[np.arange(frames), frames + channel * terms + np.arange(terms)]
            system[np.ix_(rows, rows)] += block - coupling.T @ solved[:, :-1]
            system[rows, -1] += right - coupling.T @ solved[:, -1]
            solutions.append((rows, solved))
        prior = self._prior(terms) * (noise**2 * float(weight.sum()) / frames)
        state = np.concatenate([np.log(light.gain), self._light_state(light).T.reshape(-1)])
        damping = np.full(len(prior), DAMPING * float(weight.sum()) / frames)
        damping[frames::terms] = GAUGE_WEIGHT * float(weight.sum())
        step = np.linalg.solve(system[:, :-1] + prior + np.diag(damping), system[:, -1] - prior @ state)
        small = np.clip(step, -MAX_STEP, MAX_STEP)
        albedo = np.stack([solved[:, -1] - solved[:, :-1] @ small[rows] for rows, solved in solutions], axis=1)
        moved = small[frames:].reshape(3, terms).T
        key = light.key_irradiance if self.visibility is None else light.key_irradiance + moved[-1]
        changed = replace(
            light,
            coefficients=light.coefficients + moved[:9],
            key_irradiance=np.maximum(key, 0.0),
            gain=light.gain * np.exp(small[:frames]),
        )
        return LightFit(changed, fit.log_albedo + np.clip(albedo, -MAX_STEP, MAX_STEP))

    def _light_state(self, light: VideoLight) -> np.ndarray:
        """Return the coefficients, and the key light where there is one: one column a channel."""
        key = [] if self.visibility is None else [light.key_irradiance]
        return np.stack([*light.coefficients, *key])

    def _prior(self, terms: int) -> np.ndarray:
        """Return the normal matrix of the priors of log gains and light, relative to the observations of a frame."""
        matrix = np.diag(np.r_[np.full(self.view_count, GAIN_PRIOR), np.zeros(3 * terms)])
        between_channels = np.eye(3) - 1.0 / 3.0
        for term in range(1, terms):
            rows = self.view_count + term + terms * np.arange(3)
            matrix[np.ix_(rows, rows)] += COLOUR_PRIOR * between_channels
            if term < BASIS_SIZE:
                matrix[rows, rows] += SHAPE_PRIOR
        return matrix

    def _light_basis(self, light: VideoLight) -> np.ndarray:
        """Return the derivative of the irradiance by the coefficients, and by the key light where there is one."""
        lambert = self._lambert(light)
        return self.basis if lambert is None else np.column_stack([self.basis, lambert])

    def _channel_blocks(self, jacobian: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the blocks (albedos x light) and (others x others) of one channel's normal matrix.

        The others are the log gains and the light; `jacobian` is the derivative of the logarithm by the light.
        """
        vertex, frame, frames = self.observed.vertex, self.observed.frame, self.view_count
        weighted = weight[:, None] * jacobian
        per_vertex = np.stack([np.bincount(vertex, column, self.vertex_count) for column in weighted.T], axis=1)
        gain_light = np.stack([np.bincount(frame, column, frames) for column in weighted.T], axis=1)
        gains = np.diag(np.bincount(frame, weight, frames))
        block = np.block([[gains, gain_light], [gain_light.T, weighted.T @ jacobian]])
        return per_vertex, block

    def _albedo_matrix(self, weight: np.ndarray, log_albedo: np.ndarray) -> tuple[csc_array, csc_array]:
        """Return the normal matrix of the albedos, data and prior, and the prior's part."""
        per_vertex = np.bincount(self.observed.vertex, weight, self.vertex_count)
        scale = float(np.median(per_vertex[per_vertex > 0]))
        first, second = self.edges.T
        difference = np.linalg.norm(log_albedo[first] - log_albedo[second], axis=1)
        edge = ALBEDO_SMOOTHNESS * scale / (1.0 + (difference / ALBEDO_EDGE) ** 2) ** 2
        edge[(per_vertex[first] == 0) | (per_vertex[second] == 0)] = 0.0
        rows, columns = np.r_[first, second], np.r_[second, first]
        neighbours = coo_array((np.r_[edge, edge], (rows, columns)), shape=(self.vertex_count,) * 2)
        prior = csc_array(diags_array(np.bincount(rows, np.r_[edge, edge], self.vertex_count)) - neighbours)
        return csc_array(prior + diags_array(per_vertex + 1e-6 * scale)), prior
