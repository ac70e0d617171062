"""Least squares of highlights at the vertices of a mesh: y = albedo * E(n) + s * D, with the albedo eliminated.

See `pipeline.texture.lighting.specular` for the model.
"""

from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.geometry.colour import srgb_to_linear
from pipeline.texture.light import Highlights, VideoLight
from pipeline.texture.lighting.light_evidence import standard_errors
from pipeline.texture.lighting.light_fit import ViewObservations

RIDGE_FRACTION = 0.003
"""Ridge of the strength, relative to the lobe's power at well-observed vertices of uniform albedo."""

UNKNOWNS = 2
"""Of a vertex: its albedo and its strength."""

CONFIDENCE_STANDARD_ERRORS = 2.0
"""Half width of the confidence interval of a vertex's strength. 1, 2 and 3: 33.35, 33.33, 33.30 dB in validation frames
of a shiny patch, 31.24 dB without an upper limit."""

MIN_ROWS = 10
"""Vertices of a region that a view must show to count."""

MIN_LINEAR = 0.02
"""Linear colour below which noise does not fall any more."""


@dataclass(frozen=True)
class HighlightRegression:
    """Rows of the model equation: what views show of vertices.

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
    def of_views(observed: ViewObservations, light: VideoLight) -> "HighlightRegression":
        """Return the rows of observed views under a light, with or without shadows of a key light."""
        rows = observed.rows
        linear = srgb_to_linear(rows.colour.astype(np.float64)) / observed.gain[rows.frame, None]
        to_camera = np.zeros_like(linear)
        for number, view in enumerate(observed.views):
            here = rows.frame == number
            to_camera[here] = view.camera.centre_m() - view.vertices_world.numpy()[rows.vertex[here]]
        to_camera /= np.maximum(np.linalg.norm(to_camera, axis=1, keepdims=True), 1e-9)
        irradiance = light.irradiance(rows.normal, observed.visibility).astype(np.float64)
        weight = rows.weight / (linear.mean(axis=1) + MIN_LINEAR)
        return HighlightRegression(
            rows.vertex, rows.frame, linear, irradiance, observed.visibility, rows.normal, to_camera, weight
        )

    def weighted(self, factor: Float[np.ndarray, "k"]) -> "HighlightRegression":
        """Return the rows with their weights multiplied."""
        return replace(self, weight=self.weight * factor)

    def select(self, rows: Bool[np.ndarray, "k"]) -> "HighlightRegression":
        """Return some of the rows."""
        return HighlightRegression(*(getattr(self, field.name)[rows] for field in fields(self)))

    def lobe(self, highlights: Highlights, exponent: Float[np.ndarray, "v"] | None = None) -> Float[np.ndarray, "k"]:
        """Return D of each row; exponent: of each vertex, None: that of the highlights."""
        own = None if exponent is None else exponent[self.vertex]
        return highlights.lobe(self.normal, self.to_camera, self.visibility, own)

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
        return np.asarray(values - (above / np.maximum(below, 1e-12))[self.vertex] * shading)

    def normal_equations(
        self, lobe: Float[np.ndarray, "k"], count: int
    ) -> tuple[Float[np.ndarray, "v"], Float[np.ndarray, "v 3"]]:
        """Return the power of the lobe (D of each row) at each vertex, and its products with the three channels."""
        lobe = self._eliminated(lobe, count)
        power = np.bincount(self.vertex, self.weight * lobe**2, count)
        return power, np.stack(
            [np.bincount(self.vertex, self.weight * lobe * channel, count) for channel in self.linear.T], axis=1
        )

    def largest_strength(self, lobe: Float[np.ndarray, "k"], count: int) -> Float[np.ndarray, "v"]:
        """Return the upper end of the confidence interval of the strength of each vertex, from its own rows alone.

        inf where they do not tell: the lobe (D of each row) does not change over fewer than three rows.
        """
        power, products = self.normal_equations(lobe, count)
        product = products.mean(axis=1)
        rows = np.bincount(self.vertex, minlength=count)
        total = np.zeros(count)
        for channel in self.linear.T:
            total += np.bincount(self.vertex, self.weight * self._eliminated(channel, count) ** 2, count) / 3.0
        is_told = (rows > UNKNOWNS) & (power > 1e-12)
        power = np.where(is_told, power, 1.0)
        variance = np.maximum(total - product**2 / power, 0.0) / np.maximum(rows - UNKNOWNS, 1)
        largest = product / power + CONFIDENCE_STANDARD_ERRORS * np.sqrt(variance / power)
        return np.where(is_told, np.maximum(largest, 0.0), np.inf)

    def explained(self, lobe: Float[np.ndarray, "k"], count: int) -> float:
        """Return by how much grey highlights of strength >= 0 reduce the weighted squared error."""
        power, products = self.normal_equations(lobe, count)
        product = np.maximum(products.min(axis=1), 0.0)
        return float(np.sum(product**2 / (power + ridge(power))))

    def squared_errors(
        self, highlight: Float[np.ndarray, "k"], albedo: Float[np.ndarray, "v 3"]
    ) -> Float[np.ndarray, "k"]:
        """Return the weighted squared error of each row; highlight: s * D."""
        predicted = albedo[self.vertex] * self.irradiance + highlight[:, None]
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


def ridge(power: Float[np.ndarray, "v"]) -> float:
    """Return the regularisation of s: a fraction of the power at well-observed vertices of uniform albedo."""
    seen = power[power > 0.0]
    return max(RIDGE_FRACTION * float(np.quantile(seen, 0.95)), 1e-12) if len(seen) else 1e-12
