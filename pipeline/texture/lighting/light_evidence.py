"""Decide from validation frames whether the light of a video can be removed, and find the exposure of every frame."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from pipeline.capture.frame_selection import evenly_spaced
from pipeline.texture.bake import TexturedSurface
from pipeline.texture.light import VideoLight
from pipeline.texture.lighting.key_light import find_key_direction
from pipeline.texture.lighting.light_fit import (
    LightFit,
    LightObservations,
    Prediction,
    ViewObservations,
    fit_light,
    mean_log_albedo,
    observe_light,
    observe_visibility,
    predict_views,
)
from pipeline.texture.settings import TextureSettings
from pipeline.texture.views import BakeView

MAX_FIT_VIEWS = 36
"""Views that determine the light; the others have only their gain fitted."""

MIN_GAIN_SPREAD = 0.02
"""Standard deviation of the log gains of the frames below which the exposure is taken as constant."""

MIN_IMPROVEMENT = 1.0
"""Standard errors by which the mean error of validation frames must fall."""


@dataclass(frozen=True)
class LightEvidence:
    """The light of a video, and what validation frames say about it.

    Attributes:
        light: as estimated; `gain` has one entry per training view.
        explained: fraction of the squared error of validation frames, in the logarithm of linear colour after one gain
            a frame, that the light explains; nan without validation frames.
        standard_errors: mean decrease of that error by the light, divided by its standard error.
        key_standard_errors: the same for the shadows of the key light, against the light without; 0 if not tried.
        gain_is_smooth: the gains of validation frames lie nearer to those of the training frames around them than to 1.
        train, validation: what the light was fitted to, and what it was tested on.
    """

    light: VideoLight
    explained: float
    standard_errors: float
    key_standard_errors: float
    gain_is_smooth: bool
    train: ViewObservations
    validation: ViewObservations

    @property
    def helps(self) -> bool:
        """Whether removing the light is supported by the validation frames."""
        return bool(self.standard_errors > MIN_IMPROVEMENT)

    def for_capture(self, train: Int[np.ndarray, "t"], frames: int, *, is_removed: bool) -> VideoLight:
        """Return the light with a gain for each of `frames` selected frames.

        Training frames have their own gain, others the interpolated one if `gain_is_smooth`, else 1. Nothing of a
        held-out image enters.

        train: positions of the training views. is_removed: False keeps the light in the texture: uniform light.
        """
        log_gain = np.zeros(frames)
        if float(np.log(self.light.gain).std()) > MIN_GAIN_SPREAD:
            if self.gain_is_smooth:
                log_gain = np.interp(np.arange(frames), train, np.log(self.light.gain))
            log_gain[train] = np.log(self.light.gain)
        light = self.light if is_removed else VideoLight.uniform(frames)
        return replace(light, gain=np.exp(log_gain).astype(np.float32))


def estimate_light(
    train: Sequence[BakeView],
    validation: Sequence[BakeView],
    surface: TexturedSurface,
    edges: Int[np.ndarray, "e 2"],
    positions: tuple[Int[np.ndarray, "t"], Int[np.ndarray, "w"]],
    settings: TextureSettings,
) -> LightEvidence:
    """Fit the light to training views and test it on validation views.

    The light is tested against a constant one, and a key light with cast shadows against the light without shadows: the
    mean error of validation frames must fall by more than `MIN_IMPROVEMENT` standard errors.

    Args:
        train, validation: views; at least one validation view.
        surface: see `pipeline.texture.vertex_texels`.
        edges: of the mesh.
        positions: of the training and the validation views among the selected frames.
        settings: of the stage.
    """
    count = surface.texels.size_px
    chosen = evenly_spaced(len(train), MAX_FIT_VIEWS)
    fit_views = [train[number] for number in chosen]
    observed, held_out = (observe_light(views, surface, settings) for views in (fit_views, validation))
    fit = fit_light(observed, edges, count, len(fit_views))
    constant = _constant_light(observed, fit.light.gain, count)
    visibility, lit = np.ones(len(observed.vertex)), np.ones(len(held_out.vertex))
    before, after = (predict_views(each, held_out, lit, len(validation)) for each in (constant, fit))
    key_errors = 0.0
    if _improvement(before, after) > MIN_IMPROVEMENT:
        direction = find_key_direction(fit_views, surface.faces, observed, fit)
        start = replace(fit, light=replace(fit.light, key_direction=direction))
        shaded = [
            observe_visibility(views, surface.faces, rows, direction)
            for views, rows in ((fit_views, observed), (validation, held_out))
        ]
        shadowed = fit_light(observed, edges, count, len(fit_views), shaded[0], start)
        prediction = predict_views(shadowed, held_out, shaded[1], len(validation))
        key_errors = _improvement(after, prediction)
        if key_errors > MIN_IMPROVEMENT and shadowed.light.casts_shadows:
            fit, after, (visibility, lit) = shadowed, prediction, shaded
    gain = _all_gains(train, chosen, fit, surface, settings)
    total = float(before.squared_error.sum())
    return LightEvidence(
        light=replace(fit.light, gain=gain),
        explained=1.0 - float(after.squared_error.sum()) / total if total > 0 else float("nan"),
        standard_errors=_improvement(before, after),
        key_standard_errors=key_errors,
        gain_is_smooth=_is_smooth(np.log(gain), after.log_gain, positions),
        train=ViewObservations(fit_views, observed, visibility, fit.light.gain),
        validation=ViewObservations(validation, held_out, lit, np.exp(after.log_gain)),
    )


def _constant_light(observed: LightObservations, gain: np.ndarray, vertex_count: int) -> LightFit:
    irradiance = np.ones((len(observed.vertex), 3))
    return LightFit(VideoLight.uniform(len(gain)), mean_log_albedo(observed, irradiance, gain, vertex_count))


def _improvement(before: Prediction, after: Prediction) -> float:
    return standard_errors(before.squared_error - after.squared_error)


def standard_errors(decrease: Float[np.ndarray, "n"]) -> float:
    """Return the mean of a decrease of the error over views, divided by its standard error; 0 with fewer than two."""
    if len(decrease) < 2:
        return 0.0
    standard_error = float(decrease.std(ddof=1)) / math.sqrt(len(decrease))
    return float(decrease.mean()) / max(standard_error, 1e-12)


def _is_smooth(train: np.ndarray, validation: np.ndarray, positions: tuple[np.ndarray, np.ndarray]) -> bool:
    """Return whether interpolated log gains of training views predict those of validation views better than 0."""
    interpolated = np.interp(positions[1], positions[0], train)
    return bool(np.sum((validation - interpolated) ** 2) < np.sum(validation**2))


def _all_gains(
    train: Sequence[BakeView], chosen: np.ndarray, fit: LightFit, surface: TexturedSurface, settings: TextureSettings
) -> Float[np.ndarray, "t"]:
    """Return the gain of every training view: as fitted, or from the fitted light and albedo."""
    gain = np.ones(len(train), dtype=np.float32)
    gain[chosen] = fit.light.gain
    others = np.setdiff1d(np.arange(len(train)), chosen)
    if len(others):
        gain[others] = np.exp(predicted_log_gain([train[number] for number in others], fit, surface, settings))
    return gain


def predicted_log_gain(
    views: Sequence[BakeView], fit: LightFit, surface: TexturedSurface, settings: TextureSettings
) -> Float[np.ndarray, "n"]:
    """Return the log gain of views that were not fitted."""
    observed = observe_light(views, surface, settings)
    lit = np.ones(len(observed.vertex))
    if fit.light.casts_shadows:
        lit = observe_visibility(views, surface.faces, observed, fit.light.key_direction)
    return predict_views(fit, observed, lit, len(views)).log_gain
