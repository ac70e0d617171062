"""Highlights of a turning ball against the model equation, and against changes that are none."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
import torch
from scipy.spatial import ConvexHull

from pipeline.geometry.camera import Camera
from pipeline.geometry.colour import linear_to_srgb
from pipeline.geometry.mesh import Mesh
from pipeline.texture.light import (
    Highlights,
    VertexGloss,
    VideoLight,
    exponent_of_roughness,
    roughness_of_exponent,
)
from pipeline.texture.lighting.light_fit import LightObservations, ViewObservations
from pipeline.texture.lighting.specular import SpecularFit, albedo_uniformity, dielectric_specular_factor, fit_specular
from pipeline.texture.lighting.specular_regression import HighlightRegression
from pipeline.texture.views import BakeView

LAMP = np.array([0.36, 0.48, 0.8])
VERTICES, MANY_VERTICES = 500, 2000


@lru_cache
def ball(vertices: int = VERTICES) -> Mesh:
    points = np.random.default_rng(0).normal(size=(vertices, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    return Mesh(points.astype(np.float32), ConvexHull(points).simplices.astype(np.int32))


def lamp_light(frames: int) -> VideoLight:
    coefficients = np.zeros((9, 3))
    coefficients[0], coefficients[1:4] = 0.8, 0.3 * LAMP[:, None]
    return replace(VideoLight.uniform(frames), coefficients=coefficients)


def filmed(
    radiance: np.ndarray,
    angles: np.ndarray,
    noise: float,
    tilt_rad: float = 0.0,
    exponent: np.ndarray | float = 24.0,
    albedo: np.ndarray | float = 0.2,
) -> ViewObservations:
    """Observations of a grey ball that turns in front of a far camera; radiance: RGB of the highlight a vertex.

    tilt_rad: error of the normals. exponent: of the lobe, one a vertex. albedo: linear, one a vertex.
    """
    count = len(radiance)
    mesh, light = ball(count), lamp_light(1)
    random, views, parts = np.random.default_rng(len(angles)), [], []
    camera = Camera(100.0, 100.0, 50.0, 50.0, 100, 100, np.diag([1.0, -1.0, -1.0, 1.0]).astype(np.float32))
    camera.world_to_camera[2, 3] = 100.0
    wrong = random.normal(size=(count, 3)) * tilt_rad
    for frame, angle in enumerate(angles):
        c, s = np.cos(angle), np.sin(angle)
        turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
        normal = mesh.vertices @ turn.T
        shown = (mesh.vertices + wrong) @ turn.T
        shown /= np.linalg.norm(shown, axis=1, keepdims=True)
        vertices = torch.from_numpy(normal.astype(np.float32))
        blank = np.zeros((1, 1, 3), np.uint8)
        views.append(BakeView(blank, blank[..., 0], camera, vertices, vertices[:, 2]))
        to_camera = camera.centre_m() - normal
        to_camera /= np.linalg.norm(to_camera, axis=1, keepdims=True)
        half = (LAMP + to_camera) / np.linalg.norm(LAMP + to_camera, axis=1, keepdims=True)
        lobe = (shown @ LAMP > 0) * np.maximum(np.sum(shown * half, axis=1), 0.0) ** exponent
        diffuse = np.reshape(albedo, (-1, 1)) * light.irradiance(shown, np.ones(count))
        linear = diffuse + lobe[:, None] * radiance
        colour = linear_to_srgb(linear) + noise * random.normal(size=linear.shape)
        seen = np.flatnonzero(normal[:, 2] > 0.25)
        parts.append((np.full(len(seen), frame), seen, colour[seen], normal[seen, 2], normal[seen]))
    rows = LightObservations(*(np.concatenate(part) for part in zip(*parts, strict=True)))
    return ViewObservations(views, rows, np.ones(len(rows.vertex)), np.ones(len(angles)))


def fitted(
    radiance: np.ndarray,
    noise: float = 0.01,
    tilt_rad: float = 0.0,
    exponent: np.ndarray | float = 24.0,
    albedo: np.ndarray | float = 0.2,
) -> SpecularFit:
    angles = 2.0 * np.pi * np.arange(32) / 32
    train, validation = (
        filmed(radiance, part, noise, tilt_rad, exponent, albedo) for part in (angles, angles[::4] + 0.1)
    )
    return fit_specular(train, validation, lamp_light(32), ball(len(radiance)))


def test_a_shiny_patch_and_its_lobe_are_found() -> None:
    """A half of the ball, on the parallels whose normals reach the half vector during the turn."""
    vertices = ball().vertices
    reached = (vertices[:, 1] > -0.1) & (vertices[:, 1] < 0.55)
    shiny = vertices[:, 0] > 0.0
    result = fitted(0.3 * np.repeat(shiny[:, None], 3, axis=1))
    assert float(result.highlights.direction @ LAMP) > np.cos(np.radians(10.0))
    assert result.highlights.exponent in (12.0, 24.0, 48.0)
    assert np.corrcoef(result.strength[reached], shiny[reached])[0, 1] > 0.6
    assert 0.1 < np.median(result.strength[reached & shiny]) < 0.4
    assert np.median(result.strength[reached & ~shiny]) < 0.05


def test_where_most_light_comes_from_below_a_matte_person_stays_matte() -> None:
    """A white floor: no lamp is searched below the person."""
    nothing = np.zeros((len(ball().vertices), 3))
    angles = 2.0 * np.pi * np.arange(32) / 32
    train, validation = (filmed(nothing, part, 0.01) for part in (angles, angles[::4] + 0.1))
    coefficients = np.zeros((9, 3))
    coefficients[0], coefficients[2] = 0.8, -0.3
    light = replace(VideoLight.uniform(32), coefficients=coefficients)
    result = fit_specular(train, validation, light, ball(len(nothing)))
    assert result.regions == 0
    assert not result.strength.any()


def test_a_small_shiny_region_is_found_on_a_person_with_wrong_normals() -> None:
    """Highlights explain little of the error of the whole surface, but most of it where they are."""
    vertices = ball().vertices
    shiny = (vertices[:, 0] > 0.7) & (np.abs(vertices[:, 1] - 0.2) < 0.3)
    result = fitted(0.3 * np.repeat(shiny[:, None], 3, axis=1), tilt_rad=0.04)
    assert 1 <= result.regions <= 6
    assert result.strength[shiny].mean() > 0.08
    assert result.strength[vertices[:, 0] < 0.0].max() < 0.02


def test_each_of_two_materials_has_its_exponent_and_the_lamp_its_direction() -> None:
    """A wide lobe on the left half of the ball and a narrow one on the right; regions that tell nothing have neither.

    With one exponent for all the lamp is 9 degrees off.
    """
    vertices = ball(MANY_VERTICES).vertices
    left = vertices[:, 0] < 0.0
    shiny = (vertices[:, 1] > -0.1) & (vertices[:, 1] < 0.55)
    result = fitted(0.3 * np.repeat(shiny[:, None], 3, axis=1), exponent=np.where(left, 12.0, 96.0))
    assert result.roughness is not None
    assert float(result.highlights.direction @ LAMP) > np.cos(np.radians(4.0))
    for half, exponent in ((left, 12.0), (~left, 96.0)):
        rows = shiny & half & (np.abs(vertices[:, 0]) > 0.2)
        mean = np.average(result.roughness[rows], weights=result.strength[rows])
        assert mean == pytest.approx((2.0 / (exponent + 2.0)) ** 0.25, rel=0.07)
    matte = (result.strength == 0.0) & (np.abs(vertices[:, 1] - 0.2) > 0.65)
    assert matte.sum() > 300
    np.testing.assert_allclose(result.roughness[matte], result.highlights.roughness, rtol=1e-6)


def test_a_matte_hem_takes_no_strength_from_the_shiny_cloth_above_it() -> None:
    """Of the same albedo, across stripes: next to them the colours of a vertex count little in a neighbourhood.

    Without the limit by the vertex itself the strength of the hem is 0.12 in the mean.
    """
    vertices = ball(MANY_VERTICES).vertices
    shiny = (vertices[:, 1] > 0.1) & (vertices[:, 1] < 0.55)
    hem = (vertices[:, 1] > -0.15) & (vertices[:, 1] < 0.1)
    striped = hem & (np.random.default_rng(1).random(MANY_VERTICES) < 0.3)
    result = fitted(0.3 * np.repeat(shiny[:, None], 3, axis=1), albedo=np.where(striped, 0.5, 0.2))
    assert np.median(result.strength[shiny]) > 0.2
    assert result.strength[hem].mean() < 0.04


def test_the_largest_strength_is_the_end_of_the_interval_of_a_linear_regression() -> None:
    """y = albedo * E + s * D by numpy: s + 2 standard errors; no limit with two rows, or where D follows E."""
    random, rows = np.random.default_rng(0), 12
    shading, lobe = random.uniform(0.5, 1.5, rows), random.uniform(0.0, 1.0, rows)
    weight = random.uniform(1.0, 4.0, rows)
    colour = 0.4 * shading + 0.2 * lobe + 0.05 * random.normal(size=rows)
    design = np.sqrt(weight)[:, None] * np.column_stack([shading, lobe])
    (_, strength), error, _, _ = np.linalg.lstsq(design, np.sqrt(weight) * colour, rcond=None)
    covariance = error[0] / (rows - 2) * np.linalg.inv(design.T @ design)
    vertex = np.r_[np.zeros(rows, int), 1, 1, np.full(rows, 2)]
    shading, lobe = np.r_[shading, 1.0, 2.0, shading], np.r_[lobe, 0.0, 1.0, 0.5 * shading]
    three = np.repeat(np.r_[colour, 1.0, 2.0, colour][:, None], 3, axis=1)
    same, ones, up = np.repeat(shading[:, None], 3, axis=1), np.ones(len(vertex)), np.zeros((len(vertex), 3))
    weights = np.r_[weight, 1.0, 1.0, weight]
    regression = HighlightRegression(vertex, np.arange(len(vertex)), three, same, ones, up, up, weights)
    largest = regression.largest_strength(lobe, 4)
    assert largest[0] == pytest.approx(strength + 2.0 * np.sqrt(covariance[1, 1]), rel=1e-9)
    assert np.isinf(largest[1:]).all()


def test_regions_that_hardly_tell_their_exponent_have_that_of_the_whole_person() -> None:
    """Exponent 20 is between two candidates, 16 and 24, so noise would choose between them from region to region."""
    vertices = ball(MANY_VERTICES).vertices
    right = vertices[:, 0] > 0.0
    shiny = (vertices[:, 1] > -0.1) & (vertices[:, 1] < 0.55)
    result = fitted(0.3 * np.repeat(shiny[:, None], 3, axis=1), exponent=np.where(right, 96.0, 20.0))
    assert result.roughness is not None
    wide = shiny & (vertices[:, 0] < -0.3) & (result.strength > 0.0)
    assert wide.sum() > 200
    np.testing.assert_allclose(result.roughness[wide], result.highlights.roughness, rtol=1e-6)


@pytest.mark.parametrize("exponent", [16.0, 64.0])
def test_one_material_has_one_exponent_and_no_map(exponent: float) -> None:
    vertices = ball(MANY_VERTICES).vertices
    shiny = (vertices[:, 1] > -0.1) & (vertices[:, 1] < 0.55)
    result = fitted(0.3 * np.repeat(shiny[:, None], 3, axis=1), exponent=exponent)
    assert result.roughness is None
    assert result.highlights.exponent == exponent
    assert result.roughness_standard_errors == 0.0


def test_matte_balls_have_no_highlights() -> None:
    result = fitted(np.zeros((VERTICES, 3)))
    assert not result.strength.any()


def test_wrong_normals_are_no_highlights() -> None:
    assert not fitted(np.zeros((VERTICES, 3)), tilt_rad=0.1).strength.any()


def test_coloured_changes_are_no_highlights() -> None:
    tinted = np.zeros((VERTICES, 3))
    tinted[::2], tinted[1::2] = [0.3, 0.0, 0.0], [0.0, 0.2, 0.2]
    assert fitted(tinted).strength.mean() < 0.25 * fitted(np.full((VERTICES, 3), 0.2)).strength.mean()


def test_roughness_has_the_width_of_the_lobe() -> None:
    """Half width of Beckmann's distribution, exp(-tan^2 / alpha^2) / cos^4 with alpha = roughness^2, and of cos^p."""
    for exponent in (12.0, 48.0):
        alpha = Highlights(LAMP, exponent).roughness ** 2
        angle = np.arccos(0.5 ** (1.0 / exponent))
        beckmann = np.exp(-((np.tan(angle) / alpha) ** 2)) / np.cos(angle) ** 4
        assert beckmann == pytest.approx(0.5, abs=0.05)


def test_roughness_and_exponent_are_inverse() -> None:
    exponent = np.array([1.0, 12.0, 64.0])
    np.testing.assert_allclose(exponent_of_roughness(roughness_of_exponent(exponent)), exponent, rtol=1e-12)
    np.testing.assert_allclose(roughness_of_exponent(np.array([0.0, 30.0])), [1.0, 0.5], rtol=1e-12)


def test_vertices_of_another_roughness_are_shaded_with_its_lobe() -> None:
    """Shading with a roughness a vertex takes each vertex from the shading with that lobe alone."""
    mesh, light = ball(), lamp_light(1)
    vertices, faces = torch.from_numpy(mesh.vertices), torch.from_numpy(mesh.faces)
    strength, camera_m = torch.full((VERTICES,), 0.3), np.array([0.0, 0.0, 50.0])
    left = mesh.vertices[:, 0] < 0.0
    roughness = torch.from_numpy(roughness_of_exponent(np.where(left, 16.0, 64.0)))
    gloss = VertexGloss(Highlights(LAMP, 24.0), strength, roughness)
    shaded = light.shade_specular(vertices, faces, None, gloss, camera_m).numpy()
    for half, exponent in ((left, 16.0), (~left, 64.0)):
        alone = VertexGloss(Highlights(LAMP, exponent), strength)
        expected = light.shade_specular(vertices, faces, None, alone, camera_m).numpy()
        np.testing.assert_allclose(shaded[half], expected[half], atol=1e-5)
        assert expected[half, 3].max() > 0.2


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
    strength = np.array([reflected_at_the_peak(factor, roughness, 0.6 * np.pi)])
    np.testing.assert_allclose(dielectric_specular_factor(strength, roughness, 0.6), factor, atol=1e-6)


def test_the_specular_factor_is_clipped_at_one() -> None:
    factor = dielectric_specular_factor(np.array([0.0, 0.9]), 0.85, 1.0)
    np.testing.assert_array_equal(factor, [0.0, 1.0])


def test_uniformity_is_low_at_an_albedo_edge() -> None:
    albedo = np.full((5, 3), 0.5)
    albedo[3:, 0] = 0.9
    uniformity = albedo_uniformity(albedo, np.array([[0, 1], [1, 2], [2, 3], [3, 4]]))
    np.testing.assert_allclose(uniformity[[0, 1, 4]], 1.0)
    assert np.all(uniformity[[2, 3]] < 0.01)
