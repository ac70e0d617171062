"""Highlights, shading and plain paint, told apart on observations made from the model's own equation and on others."""

import numpy as np
import pytest
import torch

from pipeline.texture.bake import BakeConfig, TexturedSurface
from pipeline.texture.specular import (
    VertexObservations,
    albedo_uniformity,
    dielectric_specular_factor,
    fit_specular,
    observe_vertices,
    real_spherical_harmonics,
    texels_at_vertices,
)
from tests.mesh.painted_ball import PaintedBall, ball_colours

VERTICES, LIGHT = 400, np.array([0.3, 0.6, 0.74])


def synthetic_observations(
    frames: int, specular_amplitude: np.ndarray, shade: float, noise: float, seed: int
) -> VertexObservations:
    """A turning cloud of oriented vertices under one light, seen from +Z; shine: each vertex's highlight amplitude."""
    base = np.random.default_rng(0)
    normals = base.normal(size=(VERTICES, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    albedo = base.uniform(0.2, 0.6, (VERTICES, 3))
    random = np.random.default_rng(seed)
    parts = []
    for angle in random.uniform(0, 2 * np.pi, frames):
        c, s = np.cos(angle), np.sin(angle)
        normal = normals @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]).T
        seen = np.flatnonzero(normal[:, 2] > 0.1)
        n = normal[seen]
        reflection_direction = 2.0 * n[:, 2:] * n - [0.0, 0.0, 1.0]
        lambert = 1.0 + shade * (n @ LIGHT)
        highlight = np.maximum(reflection_direction @ LIGHT, 0.0) ** 6
        colour = albedo[seen] * lambert[:, None] + specular_amplitude[seen] * highlight[:, None]
        colour += noise * random.normal(size=colour.shape)
        parts.append((seen.astype(np.int32), colour, n[:, 2] ** 2, n, reflection_direction))
    joined = [np.concatenate(part) for part in zip(*parts, strict=True)]
    return VertexObservations(joined[0], *(values.astype(np.float32) for values in joined[1:]))


def fitted(specular_amplitude: np.ndarray, shade: float, noise: float = 0.01):
    sets = [
        synthetic_observations(frames, specular_amplitude, shade, noise, seed) for frames, seed in ((60, 1), (15, 2))
    ]
    neighbours = np.stack([np.arange(VERTICES), np.arange(VERTICES)], axis=1)  # paint without edges
    return fit_specular(*sets, neighbours, VERTICES, min_partial_r2=0.02)


def test_highlights_are_found_where_they_are() -> None:
    specular_amplitude = np.zeros((VERTICES, 3))
    specular_amplitude[: VERTICES // 2] = 0.4
    result = fitted(specular_amplitude, shade=0.3)
    shiny, matte = result.amplitude[: VERTICES // 2], result.amplitude[VERTICES // 2 :]
    assert result.partial_r2 > 0.3
    assert shiny.mean() > 4.0 * matte.mean()
    assert 0.05 < np.quantile(shiny, 0.75) < 0.5  # true is 0.4: what was weakly seen is held down
    assert result.amplitude.min() >= 0.0
    assert result.amplitude.max() <= 1.0


@pytest.mark.parametrize("shade", [0.0, 0.5])
def test_paint_and_shading_alone_stay_matte(shade: float) -> None:
    result = fitted(np.zeros((VERTICES, 3)), shade)
    assert result.partial_r2 < 0.02
    assert not result.amplitude.any()


def test_changes_with_a_colour_are_no_highlights() -> None:
    tinted = np.zeros((VERTICES, 3))
    tinted[: VERTICES // 2], tinted[VERTICES // 2 :] = [0.4, 0.0, 0.0], [0.0, 0.4, 0.4]
    white = fitted(np.full((VERTICES, 3), 0.3), shade=0.2)
    assert white.amplitude.mean() > 4.0 * fitted(tinted, shade=0.2).amplitude.mean()


def reflected_at_the_peak(factor: float, roughness: float, lamp: float) -> float:
    """glTF 2.0, appendix B.3, and KHR_materials_specular: linear light that a dielectric's mirror reflection adds.

    View, lamp and normal coincide. A `lamp` of pi shows white paint (albedo / pi) as 1.
    """
    n_dot_h = n_dot_l = n_dot_v = h_dot_v = 1.0
    alpha = roughness**2
    d = alpha**2 / (np.pi * (n_dot_h**2 * (alpha**2 - 1.0) + 1.0) ** 2)
    shadowed = [x + np.sqrt(alpha**2 + (1.0 - alpha**2) * x**2) for x in (n_dot_l, n_dot_v)]
    visibility = (2.0 * n_dot_l / shadowed[0]) * (2.0 * n_dot_v / shadowed[1]) / (4.0 * n_dot_l * n_dot_v)
    f0, f90 = 0.04 * factor, factor
    fresnel = f0 + (f90 - f0) * (1.0 - abs(h_dot_v)) ** 5
    return lamp * n_dot_l * fresnel * visibility * d


@pytest.mark.parametrize("roughness", [0.3, 0.5, 0.85, 1.0])
@pytest.mark.parametrize("factor", [0.0, 0.2, 0.7, 1.0])
def test_a_viewer_shows_the_highlight_that_was_seen(roughness: float, factor: float) -> None:
    base = np.array([[0.3, 0.3, 0.3], [0.6, 0.6, 0.6]])
    linear = ((base + 0.055) / 1.055) ** 2.4 + reflected_at_the_peak(factor, roughness, np.pi)
    amplitude = (1.055 * linear ** (1 / 2.4) - 0.055 - base)[:, 0]
    np.testing.assert_allclose(dielectric_specular_factor(amplitude, base, roughness), factor, atol=1e-6)


def test_no_surface_reflects_more_than_a_dielectric() -> None:
    share = dielectric_specular_factor(np.array([0.0, 0.9]), np.full((2, 3), 0.5), 0.85)
    np.testing.assert_array_equal(share, [0.0, 1.0])


def test_flatness_finds_the_border_of_a_print() -> None:
    albedo = np.full((5, 3), 0.5)
    albedo[3:, 0] = 0.9
    flat = albedo_uniformity(albedo, np.array([[0, 1], [1, 2], [2, 3], [3, 4]]))
    np.testing.assert_allclose(flat[[0, 1, 4]], 1.0)
    assert np.all(flat[[2, 3]] < 0.01)


def test_harmonics_are_orthogonal_to_each_other_and_to_constants() -> None:
    directions = np.random.default_rng(0).normal(size=(200_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    values = real_spherical_harmonics(directions, 3)
    values = values / np.sqrt((values**2).mean(axis=0))
    products = values.T @ values / len(values)
    np.testing.assert_allclose(products, np.eye(15), atol=0.02)
    np.testing.assert_allclose(values.mean(axis=0), 0.0, atol=0.02)
    assert real_spherical_harmonics(directions[:5], 2).shape == (5, 8)


def test_vertices_are_observed_at_their_own_colour() -> None:
    ball = PaintedBall(4)
    count = len(ball.mesh.vertices)
    faces = torch.from_numpy(ball.mesh.faces)
    surface = TexturedSurface(faces, faces, torch.zeros(count, 2), texels_at_vertices(ball.mesh.faces, count))
    seen = observe_vertices(ball.views, surface, BakeConfig(silhouette_falloff_m=0.015))
    sure = seen.weight > 0.3
    assert sure.sum() > 200
    assert np.abs(seen.colour - ball_colours(ball.mesh.vertices[seen.vertex]))[sure].mean() < 0.02
    np.testing.assert_allclose(np.linalg.norm(seen.reflection_direction, axis=1), 1.0, atol=1e-4)
    # the camera lies along +Z of the ball: the mirrored view and the view stand symmetric about the normal
    towards = (
        seen.reflection_direction
        - 2.0 * np.sum(seen.reflection_direction * seen.normal, axis=1, keepdims=True) * seen.normal
    )
    assert np.all(-towards[:, 2] > 0.95)
