"""The specular map against the truth of a person who shines on a patch."""

from dataclasses import replace

import pytest

from data_tools.evaluate.compare_avatar import compare_texture
from data_tools.evaluate.comparison import Comparison
from data_tools.synthetic.scene.renderer import LIGHTING_PRESETS
from pipeline.texture.light import Highlights, VertexGloss


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
