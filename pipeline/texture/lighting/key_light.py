"""Find the key light of a video by the shadows that the person casts on itself."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float

from pipeline.capture.frame_selection import evenly_spaced
from pipeline.kernels.common.thread_pool import shared_thread_pool
from pipeline.texture.lighting.light_fit import LightFit, LightObservations, observe_visibility, vertex_mean
from pipeline.texture.views import BakeView

SEARCH_VIEWS, SEARCH_DIRECTIONS = 8, 48
SEARCH_REFINEMENTS_RAD = (0.25, 0.12)
MIN_KEY_HEIGHT = -0.1
"""Upward component of the lowest direction that is tried as key light."""


def find_key_direction(
    views: Sequence[BakeView], faces: torch.Tensor, observed: LightObservations, fit: LightFit
) -> Float[np.ndarray, "3"]:
    """Return the direction of a light whose cast shadows explain most of what a fit without shadows leaves.

    The camera hardly sees surfaces that face away from it, so the smooth light does not tell the direction; where
    shadows fall does. Evenly spread directions are tried in `SEARCH_VIEWS` views, then those around the best.
    """
    chosen = evenly_spaced(len(views), SEARCH_VIEWS)
    rows = np.isin(observed.frame, chosen)
    part = observed.select(rows)
    part = replace(part, frame=np.searchsorted(chosen, part.frame))
    few = [views[number] for number in chosen]
    gain = fit.light.gain[chosen]
    irradiance = fit.light.irradiance(part.normal, np.ones(len(part.normal)))
    shaded = part.log_linear() - np.log(irradiance) - np.log(gain)[part.frame, None]
    residual = (shaded - fit.log_albedo[part.vertex]).mean(axis=1)
    weight = part.log_weight()

    def explained(direction: np.ndarray) -> float:
        hidden = 1.0 - observe_visibility(few, faces, part, direction)
        lost = hidden * np.maximum(part.normal @ direction, 0.0) / irradiance.mean(axis=1)
        lost = lost - vertex_mean(part.vertex, lost, weight, len(fit.log_albedo))[part.vertex]
        left = residual - vertex_mean(part.vertex, residual, weight, len(fit.log_albedo))[part.vertex]
        product = float(np.sum(weight * left * lost))
        return product**2 / max(float(np.sum(weight * lost**2)), 1e-12) if product < 0 else 0.0

    pool, directions = shared_thread_pool(torch.get_num_threads()), search_directions()
    best = directions[int(np.argmax(pool.map(explained, directions)))]
    for angle_rad in SEARCH_REFINEMENTS_RAD:
        around = np.concatenate([best[None], directions_around(best, angle_rad)])
        best = around[int(np.argmax(pool.map(explained, around)))]
    return best


def search_directions() -> Float[np.ndarray, "n 3"]:
    """Return directions of lamps, evenly spread on a golden-angle (Fibonacci) spiral, without those from below."""
    number = np.arange(SEARCH_DIRECTIONS) + 0.5
    height, angle = 1.0 - 2.0 * number / SEARCH_DIRECTIONS, number * np.pi * (3.0 - np.sqrt(5.0))
    level = np.sqrt(1.0 - height**2)
    directions = np.stack([level * np.cos(angle), height, level * np.sin(angle)], axis=1)
    return directions[height > MIN_KEY_HEIGHT]


def directions_around(direction: np.ndarray, angle_rad: float) -> Float[np.ndarray, "6 3"]:
    """Return six directions at an angle from one."""
    across = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
    across /= np.linalg.norm(across)
    turns = np.arange(6) * np.pi / 3.0
    ring = np.cos(turns)[:, None] * across + np.sin(turns)[:, None] * np.cross(direction, across)
    return np.cos(angle_rad) * direction + np.sin(angle_rad) * ring
