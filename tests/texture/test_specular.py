"""Separation of highlights, shading and albedo, on observations made from the model equation and on others."""

import numpy as np
import pytest
import torch

from pipeline.texture.bake import TexturedSurface
from pipeline.texture.settings import TextureSettings
from pipeline.texture.specular import (
    VertexObservations,
    albedo_uniformity,
    dielectric_specular_factor,
    fit_specular,
    observe_vertices,
    real_spherical_harmonics,
    texels_at_vertices,
)
from tests.texture.painted_ball import PaintedBall, ball_colours

VERTICES, LIGHT = 400, np.array([0.3, 0.6, 0.74])


def synthetic_observations(
    frames: int, specular_amplitude: np.ndarray, shade: float, noise: float, seed: int
) -> VertexObservations:
    """Oriented vertices that turn about +Y under one light, observed from +Z; specular_amplitude: RGB per vertex."""
    base = np.random.default_rng(0)
    normals = base.normal(size=(VERTICES, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    albedo = base.uniform(0.2, 0.6, (VERTICES, 3))
    random = np.random.default_rng(seed)
    parts = []
    for angle in random.uniform(0, 2 * np.pi, frames):
        c, s = np.cos(angle), np.sin(angle)
        normal = normals @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]).T
        visible = np.flatnonzero(normal[:, 2] > 0.1)
        n = normal[visible]
        reflection_direction = 2.0 * n[:, 2:] * n - [0.0, 0.0, 1.0]
        lambert = 1.0 + shade * (n @ LIGHT)
        highlight = np.maximum(reflection_direction @ LIGHT, 0.0) ** 6
        colour = albedo[visible] * lambert[:, None] + specular_amplitude[visible] * highlight[:, None]
        colour += noise * random.normal(size=colour.shape)
        parts.append((visible.astype(np.int32), colour, n[:, 2] ** 2, n, reflection_direction))
    joined = [np.concatenate(part) for part in zip(*parts, strict=True)]
    return VertexObservations(joined[0], *(values.astype(np.float32) for values in joined[1:]))


def fitted(specular_amplitude: np.ndarray, shade: float, noise: float = 0.01):
    sets = [
        synthetic_observations(frames, specular_amplitude, shade, noise, seed) for frames, seed in ((60, 1), (15, 2))
    ]
    neighbours = np.stack([np.arange(VERTICES), np.arange(VERTICES)], axis=1)  # albedo without edges
    return fit_specular(*sets, neighbours, VERTICES, min_partial_r2=0.02)


def test_highlights_are_found_on_specular_vertices() -> None:
    specular_amplitude = np.zeros((VERTICES, 3))
    specular_amplitude[: VERTICES // 2] = 0.4
    result = fitted(specular_amplitude, shade=0.3)
    shiny, matte = result.amplitude[: VERTICES // 2], result.amplitude[VERTICES // 2 :]
    assert result.partial_r2 > 0.3
    assert shiny.mean() > 4.0 * matte.mean()
    assert 0.05 < np.quantile(shiny, 0.75) < 0.5  # true value 0.4; weakly observed vertices are shrunk
    assert result.amplitude.min() >= 0.0
    assert result.amplitude.max() <= 1.0


@pytest.mark.parametrize("shade", [0.0, 0.5])
def test_albedo_and_shading_alone_are_matte(shade: float) -> None:
    result = fitted(np.zeros((VERTICES, 3)), shade)
    assert result.partial_r2 < 0.02
    assert not result.amplitude.any()


def test_coloured_changes_are_not_highlights() -> None:
    tinted = np.zeros((VERTICES, 3))
    tinted[: VERTICES // 2], tinted[VERTICES // 2 :] = [0.4, 0.0, 0.0], [0.0, 0.4, 0.4]
    white = fitted(np.full((VERTICES, 3), 0.3), shade=0.2)
    assert white.amplitude.mean() > 4.0 * fitted(tinted, shade=0.2).amplitude.mean()


def reflected_at_the_peak(factor: float, roughness: float, lamp: float) -> float:
    """glTF 2.0, appendix B.3, and KHR_materials_specular: linear radiance that the specular lobe of a dielectric adds.

    View, light and normal coincide. A `lamp` of pi shows a white diffuse surface (albedo / pi) as 1.
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
def test_the_specular_factor_inverts_the_gltf_model(roughness: float, factor: float) -> None:
    base = np.array([[0.3, 0.3, 0.3], [0.6, 0.6, 0.6]])
    linear = ((base + 0.055) / 1.055) ** 2.4 + reflected_at_the_peak(factor, roughness, np.pi)
    amplitude = (1.055 * linear ** (1 / 2.4) - 0.055 - base)[:, 0]
    np.testing.assert_allclose(dielectric_specular_factor(amplitude, base, roughness), factor, atol=1e-6)


def test_the_specular_factor_is_clipped_at_one() -> None:
    factor = dielectric_specular_factor(np.array([0.0, 0.9]), np.full((2, 3), 0.5), 0.85)
    np.testing.assert_array_equal(factor, [0.0, 1.0])


def test_uniformity_is_low_at_an_albedo_edge() -> None:
    albedo = np.full((5, 3), 0.5)
    albedo[3:, 0] = 0.9
    uniformity = albedo_uniformity(albedo, np.array([[0, 1], [1, 2], [2, 3], [3, 4]]))
    np.testing.assert_allclose(uniformity[[0, 1, 4]], 1.0)
    assert np.all(uniformity[[2, 3]] < 0.01)


def test_harmonics_are_orthogonal_to_each_other_and_to_constants() -> None:
    directions = np.random.default_rng(0).normal(size=(200_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    values = real_spherical_harmonics(directions, 3)
    values = values / np.sqrt((values**2).mean(axis=0))
    products = values.T @ values / len(values)
    np.testing.assert_allclose(products, np.eye(15), atol=0.02)
    np.testing.assert_allclose(values.mean(axis=0), 0.0, atol=0.02)
    assert real_spherical_harmonics(directions[:5], 2).shape == (5, 8)


def test_vertices_are_observed_with_their_true_colour() -> None:
    ball = PaintedBall(4)
    count = len(ball.mesh.vertices)
    faces = torch.from_numpy(ball.mesh.faces)
    surface = TexturedSurface(faces, faces, torch.zeros(count, 2), texels_at_vertices(ball.mesh.faces, count))
    observed = observe_vertices(ball.views, surface, TextureSettings(silhouette_falloff_m=0.015))
    reliable = observed.weight > 0.3
    assert reliable.sum() > 200
    assert np.abs(observed.colour - ball_colours(ball.mesh.vertices[observed.vertex]))[reliable].mean() < 0.02
    np.testing.assert_allclose(np.linalg.norm(observed.reflection_direction, axis=1), 1.0, atol=1e-4)
    # the camera is at +Z of the ball: view and reflection direction are symmetric about the normal
    to_camera = (
        observed.reflection_direction
        - 2.0 * np.sum(observed.reflection_direction * observed.normal, axis=1, keepdims=True) * observed.normal
    )
    assert np.all(-to_camera[:, 2] > 0.95)
