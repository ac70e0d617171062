"""Strength and roughness of highlights against the truth of a person who shines in one or two places."""

from dataclasses import replace

import numpy as np
import pytest

from data_tools.evaluate.compare_avatar import compare_texture
from data_tools.evaluate.comparison import Comparison
from data_tools.evaluate.highlights import highlight_scores, lamp_error_deg
from data_tools.synthetic.rig.subject import Subject
from data_tools.synthetic.scene.renderer import LIGHTING_PRESETS
from pipeline.body.body import Body
from pipeline.texture.light import Highlights, VertexGloss
from tests.data_tools.synthetic.shapes import sphere


def test_scores_of_two_shines() -> None:
    """Exponents 64 and 16 are roughness (2/66)^(1/4) and (2/18)^(1/4); the estimate is 0.45 and 0.55."""
    vertices, faces = sphere(0.5, (0.0, 0.0, 0.0))
    weights = np.ones((len(vertices), 1), dtype=np.float32)
    body = Body(("Hips",), np.array([-1], dtype=np.int32), np.zeros((1, 3), np.float32), vertices, faces, weights, {})
    subject = Subject(body, np.zeros((len(vertices), 2), np.float32), faces, np.zeros((4, 4, 3), np.uint8))
    height, rows = vertices[faces, 1].mean(axis=1) + 0.5, np.arange(len(faces))
    first, second = (height > 0.58) & (height < 0.74), (height > 0.3) & (height < 0.5)
    light, strength = LIGHTING_PRESETS["two-shines"], np.where(first, 0.3, np.where(second, 0.1, 0.0))
    scores = highlight_scores(strength, np.where(first, 0.45, 0.55), subject, light, rows)
    wide, narrow = (2.0 / 18.0) ** 0.25, (2.0 / 66.0) ** 0.25
    total = 0.3 * first.sum() + 0.1 * second.sum()
    expected = (0.3 * first.sum() * (0.45 - narrow) + 0.1 * second.sum() * (wide - 0.55)) / total
    assert scores["roughness_error"] == pytest.approx(expected, rel=1e-5)
    assert (scores["roughness_64"], scores["roughness_16"]) == (pytest.approx(0.45), pytest.approx(0.55))
    assert scores["exponent_16"] == pytest.approx(2.0 / 0.55**4 - 2.0)
    assert 0.8 < scores["specular_correlation"] < 1.0
    assert highlight_scores(0.0 * strength, strength, subject, light, rows) == {"specular_correlation": 0.0}


def test_the_error_of_the_lamp_is_the_angle_to_the_key_light() -> None:
    key = np.array(LIGHTING_PRESETS["patch"].key_direction)
    across = np.cross(key, [0.0, 1.0, 0.0])
    for direction, expected in ((key, 0.0), (across, 90.0), (-key, 180.0)):
        error = lamp_error_deg(direction / np.linalg.norm(direction), LIGHTING_PRESETS["patch"])
        assert error == pytest.approx(expected, abs=1e-4)


@pytest.mark.slow
def test_correlation_of_highlights_with_the_true_ones(perfect: Comparison) -> None:
    """Strength by the height of a vertex: close to 1 where it is the true one, negative for the opposite."""
    assert "specular_correlation" not in compare_texture(perfect)
    shiny = replace(perfect, truth=replace(perfect.truth, light=LIGHTING_PRESETS["patch"]))
    assert compare_texture(shiny)["specular_correlation"] == 0.0
    avatar = shiny.run.avatar
    height = avatar.vertices[:, 1] - avatar.vertices[:, 1].min()
    low, high = LIGHTING_PRESETS["patch"].shiny_heights
    strength = ((height > low * height.max()) & (height < high * height.max())).float()
    for specular, range_of in ((strength, (0.9, 1.0)), (1.0 - strength, (-1.0, -0.9))):
        gloss = VertexGloss(Highlights.none(), specular)
        lit = replace(shiny, run=replace(shiny.run, avatar=replace(avatar, gloss=gloss)))
        assert range_of[0] <= compare_texture(lit)["specular_correlation"] <= range_of[1]
