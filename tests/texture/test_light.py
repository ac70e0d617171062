"""Light, gains and albedo against closed forms: a turning ball whose colours follow from the model, or from Lambert."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial import ConvexHull, cKDTree

from pipeline.core.errors import UserError
from pipeline.geometry.colour import linear_to_srgb, srgb_to_linear
from pipeline.geometry.mesh import Mesh
from pipeline.texture.bake import TexturedSurface, average_views, draw_view
from pipeline.texture.light import (
    Highlights,
    VideoLight,
    directional_light,
    load_light,
    save_light,
    spherical_harmonics,
)
from pipeline.texture.lighting.light_evidence import LightEvidence, estimate_light
from pipeline.texture.lighting.light_fit import LightObservations, ViewObservations, fit_light, predict_views
from pipeline.texture.settings import TextureSettings
from pipeline.texture.vertex_texels import texels_at_vertices
from pipeline.texture.views import BakeView, remove_light
from tests.data_tools.synthetic.shapes import sphere
from tests.texture.painted_ball import PaintedBall, ball_colours

FRAMES = 24
KEY = np.array([0.36, 0.48, 0.8])


def ball_points(count: int = 500) -> tuple[np.ndarray, np.ndarray]:
    """Unit normals that are spread over a ball, and the edges between neighbours."""
    points = np.random.default_rng(0).normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    faces = ConvexHull(points).simplices.astype(np.int32)
    return points, Mesh(points.astype(np.float32), faces).edges()


def painted(points: np.ndarray) -> np.ndarray:
    """Linear albedo with large patches of one colour, as clothes have."""
    patch = (np.floor(points @ [2.0, 1.3, 0.4]) % 3).astype(int)
    return np.array([[0.30, 0.10, 0.08], [0.12, 0.20, 0.40], [0.35, 0.30, 0.22]])[patch]


def observed(light: VideoLight, gain: np.ndarray, noise: float = 0.0) -> tuple[LightObservations, np.ndarray]:
    """What a camera on +Z sees of the turning ball, and the visibility of the key light in random shadows."""
    points, _ = ball_points()
    random, parts = np.random.default_rng(1), []
    for frame, angle in enumerate(2.0 * np.pi * np.arange(len(gain)) / len(gain)):
        c, s = np.cos(angle), np.sin(angle)
        normal = points @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]).T
        vertex = np.flatnonzero(normal[:, 2] > 0.2)
        visibility = (random.uniform(size=len(vertex)) > 0.2).astype(float)
        linear = painted(points)[vertex] * light.irradiance(normal[vertex], visibility) * gain[frame]
        colour = linear_to_srgb(linear) + noise * random.normal(size=linear.shape)
        used = (colour.min(axis=1) > 0.04) & (colour.max(axis=1) < 0.97)
        parts.append(
            (
                np.full(used.sum(), frame),
                vertex[used],
                colour[used],
                normal[vertex[used], 2],
                normal[vertex[used]],
                visibility[used],
            )
        )
    *columns, visibility = (np.concatenate(part) for part in zip(*parts, strict=True))
    return LightObservations(*columns), visibility


def relative_error(light: VideoLight, truth: VideoLight, rows: LightObservations, visibility: np.ndarray) -> float:
    """Spread of the ratio of two irradiances on observed normals: the scale is free."""
    ratio = light.irradiance(rows.normal, visibility) / truth.irradiance(rows.normal, visibility)
    return float(np.log(ratio).std(axis=0).max())


def smooth_light() -> VideoLight:
    coefficients = np.array([0.9, 0.15, 0.25, 0.3, 0.05, -0.04, 0.06, 0.03, 0.02])[:, None] * [1.0, 0.97, 0.9]
    return replace(VideoLight.uniform(1), coefficients=coefficients)


def test_spherical_harmonics_are_orthogonal() -> None:
    points = np.random.default_rng(0).normal(size=(200_000, 3))
    basis = spherical_harmonics(points / np.linalg.norm(points, axis=1, keepdims=True))
    gram = basis.T @ basis / len(basis)
    assert np.abs(gram - np.diag(np.diag(gram))).max() < 0.01
    assert np.abs(basis[:, 0] - 1.0).max() == 0.0


def test_an_exact_light_is_found() -> None:
    rows, lit = observed(smooth_light(), np.ones(FRAMES))
    fit = fit_light(rows, ball_points()[1], 500, FRAMES)
    assert relative_error(fit.light, smooth_light(), rows, lit) < 0.02
    assert np.abs(fit.light.gain - 1.0).max() < 0.01
    error = (fit.log_albedo - np.log(painted(ball_points()[0])))[np.unique(rows.vertex)]
    assert error.std(axis=0).max() < 0.03


def test_the_mean_brightness_is_kept() -> None:
    rows, lit = observed(smooth_light(), np.ones(FRAMES))
    light = fit_light(rows, ball_points()[1], 500, FRAMES).light
    mean = np.average(np.log(light.irradiance(rows.normal, lit)), axis=0, weights=rows.log_weight())
    np.testing.assert_allclose(mean, 0.0, atol=1e-6)


def test_flicker_of_thirty_percent_is_found_within_five() -> None:
    gain = np.random.default_rng(3).uniform(0.7, 1.3, FRAMES)
    rows, _ = observed(smooth_light(), gain, noise=0.02)
    found = fit_light(rows, ball_points()[1], 500, FRAMES).light.gain
    assert np.abs(found / gain * np.exp(np.log(gain).mean()) - 1.0).max() < 0.05


def test_a_tenth_of_foreign_colours_changes_little() -> None:
    rows, lit = observed(smooth_light(), np.ones(FRAMES), noise=0.01)
    random = np.random.default_rng(5)
    foreign = random.uniform(size=len(rows.vertex)) < 0.1
    colour = np.where(foreign[:, None], random.uniform(0.05, 0.95, rows.colour.shape), rows.colour)
    fit = fit_light(replace(rows, colour=colour), ball_points()[1], 500, FRAMES)
    assert relative_error(fit.light, smooth_light(), rows, lit) < 0.04


def test_a_key_light_is_found_by_its_shadows() -> None:
    truth = replace(smooth_light(), key_irradiance=np.full(3, 0.5), key_direction=KEY)
    rows, lit = observed(truth, np.ones(FRAMES))
    smooth = fit_light(rows, ball_points()[1], 500, FRAMES)
    start = replace(smooth, light=replace(smooth.light, key_direction=KEY))
    fit = fit_light(rows, ball_points()[1], 500, FRAMES, lit, start)
    assert relative_error(fit.light, truth, rows, lit) < 0.03
    ratio = fit.light.key_irradiance / fit.light.irradiance(KEY[None], np.ones(1))[0]
    np.testing.assert_allclose(ratio, 0.5 / truth.irradiance(KEY[None], np.ones(1))[0], rtol=0.1)
    after, before = (predict_views(each, rows, lit, FRAMES).squared_error.mean() for each in (fit, smooth))
    assert after < 0.1 * before


def test_irradiance_of_a_directional_light_is_lamberts() -> None:
    vertices, faces = (torch.from_numpy(array) for array in sphere(0.3, (0.0, 0.0, 0.0)))
    shaded = directional_light((0.0, 0.0, 2.0), 0.25).shade_vertices(vertices, faces)
    expected = 0.25 + (vertices[:, 2] / 0.3).clamp(min=0.0)
    away_from_terminator = vertices[:, 2].abs() > 0.1
    np.testing.assert_allclose(shaded[away_from_terminator, 1], expected[away_from_terminator], atol=0.03)


def test_removing_light_inverts_shading() -> None:
    albedo = np.random.default_rng(0).uniform(0.1, 0.6, (50, 3)).astype(np.float32)
    irradiance = np.random.default_rng(1).uniform(0.3, 1.5, (50, 3)).astype(np.float32)
    np.testing.assert_allclose(
        remove_light(linear_to_srgb(srgb_to_linear(albedo) * irradiance), irradiance), albedo, atol=1e-5
    )


def test_reading_inverts_writing_and_a_missing_array_is_named(tmp_path: Path) -> None:
    light = replace(smooth_light(), gain=np.array([0.9, 1.1], dtype=np.float32))
    save_light(tmp_path / "light.npz", light, Highlights(KEY, 24.0))
    read, highlights = load_light(tmp_path / "light.npz")
    assert highlights.exponent == 24.0
    np.testing.assert_allclose(read.coefficients, light.coefficients, rtol=1e-6)
    assert not read.is_uniform
    assert VideoLight.uniform(3).is_uniform
    np.savez(tmp_path / "damaged.npz", gain=np.ones(2))
    with pytest.raises(UserError, match="coefficients"):
        load_light(tmp_path / "damaged.npz")


class LitBall:
    """The painted ball with knobs under a light, filmed over a turn, and its evidence."""

    def __init__(self, ambient: float, key: float) -> None:
        self.ball = PaintedBall(24)
        count = len(self.ball.mesh.vertices)
        faces = self.ball.surface.faces
        self.surface = TexturedSurface(faces, faces, torch.zeros(count, 2), texels_at_vertices(faces.numpy(), count))
        lamp = directional_light((0.45, 0.5, 0.75), 1.0)
        coefficients = np.zeros((9, 3))
        coefficients[0] = ambient
        lamp = replace(lamp, coefficients=coefficients, key_irradiance=np.full(3, key))
        self.views = [self._lit(view, lamp) for view in self.ball.views]
        self.positions = np.arange(24)[np.arange(24) % 4 != 2], np.arange(24)[np.arange(24) % 4 == 2]

    def _lit(self, view: BakeView, lamp: VideoLight) -> BakeView:
        """Shade each pixel by the nearest vertex: independent of the rasteriser of the bake."""
        depth = draw_view(np.zeros((2, 2, 3), np.float32), view, self.ball.surface).depth_m.numpy()
        rows, columns = np.nonzero(np.isfinite(depth))
        camera = view.camera
        z = depth[rows, columns]
        x, y = (columns + 0.5 - camera.cx) / camera.fx, (rows + 0.5 - camera.cy) / camera.fy
        points = np.stack([x * z, -y * z, -z], axis=1)
        nearest = cKDTree(view.vertices_world.numpy()).query(points)[1]
        irradiance = lamp.shade_vertices(view.vertices_world, self.ball.surface.faces).numpy()[nearest]
        image = view.image.copy()
        linear = srgb_to_linear(image[rows, columns] / 255.0) * irradiance
        image[rows, columns] = np.rint(255.0 * np.clip(linear_to_srgb(linear), 0.0, 1.0))
        return replace(view, image=image)

    def evidence(self) -> LightEvidence:
        train, validation = ([self.views[k] for k in part] for part in self.positions)
        return estimate_light(
            train, validation, self.surface, self.ball.mesh.edges(), self.positions, TextureSettings()
        )

    def albedo_error(self, light: VideoLight) -> float:
        views = [
            replace(view, shading=light.shade_vertices(view.vertices_world, self.ball.surface.faces))
            for view in self.views
        ]
        mean = average_views(views, self.surface, TextureSettings())
        seen = mean.weight.numpy() > 0
        found, truth = mean.value().numpy()[seen], ball_colours(self.ball.mesh.vertices)[seen]
        gain = np.median(truth / np.maximum(found, 1e-3), axis=0)
        return float(np.abs(gain * found - truth).mean())


@pytest.mark.slow
def test_evidence_removes_the_light_of_a_lamp() -> None:
    scene = LitBall(ambient=0.4, key=0.6)
    evidence = scene.evidence()
    assert evidence.helps
    assert evidence.explained > 0.5
    light = evidence.for_capture(scene.positions[0], 24, is_removed=True)
    assert scene.albedo_error(light) < 0.6 * scene.albedo_error(VideoLight.uniform(24))


def test_evidence_keeps_what_was_filmed_without_lamps() -> None:
    evidence = LitBall(ambient=1.0, key=0.0).evidence()
    assert not evidence.helps
    assert evidence.for_capture(np.arange(3), 3, is_removed=False).is_uniform


def test_gains_of_other_frames_are_interpolated_where_that_predicts_validation_frames() -> None:
    gain = np.array([0.8, 1.0, 1.25], dtype=np.float32)
    rows = observed(smooth_light(), np.ones(1))[0]
    nothing = ViewObservations([], rows, np.ones(len(rows.vertex)), np.ones(1))
    evidence = LightEvidence(replace(VideoLight.uniform(3), gain=gain), 0.0, 0.0, 0.0, True, nothing, nothing)
    train = np.array([0, 2, 4])
    smooth = evidence.for_capture(train, 5, is_removed=True).gain
    np.testing.assert_allclose(smooth, [0.8, np.sqrt(0.8), 1.0, np.sqrt(1.25), 1.25], rtol=1e-6)
    jumping = replace(evidence, gain_is_smooth=False).for_capture(train, 5, is_removed=True).gain
    np.testing.assert_allclose(jumping, [0.8, 1.0, 1.0, 1.0, 1.25], rtol=1e-6)
