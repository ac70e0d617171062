"""The learnt specular feature: it finds colours that change with the view, and adds nothing to a matte surface."""

from pathlib import Path

import pytest
import torch

from data_tools.evaluate.learnt_feature import FeatureRows, fit_feature, mean_squared_error
from data_tools.evaluate.learnt_specular import main
from pipeline.geometry.colour import linear_to_srgb

VERTICES, ROWS, STEPS = 40, 2_000, 400
LAMP = torch.tensor([0.6, 0.0, 0.8])
ALBEDO = 0.1 + 0.4 * torch.rand(VERTICES, 3, generator=torch.Generator().manual_seed(1))
IS_SHINY = torch.arange(VERTICES) % 2 == 0


def rows(seed: int, strength: float) -> FeatureRows:
    """Every second vertex shines when it is seen from around `LAMP`; the irradiance changes from row to row."""
    random = torch.Generator().manual_seed(seed)
    vertex = torch.randint(VERTICES, (ROWS,), generator=random)
    direction = torch.nn.functional.normalize(torch.randn(ROWS, 3, generator=random), dim=1)
    irradiance = 0.5 + torch.rand(ROWS, 1, generator=random).expand(ROWS, 3)
    highlight = strength * IS_SHINY[vertex] * (direction @ LAMP).clamp_min(0.0) ** 8
    colour = linear_to_srgb(ALBEDO[vertex] * irradiance + highlight[:, None])
    return FeatureRows(vertex, direction, irradiance, colour, torch.ones(ROWS))


def test_highlights_are_learnt_where_the_surface_shines() -> None:
    model = fit_feature(rows(2, 0.3), ALBEDO, 1e-3, 0, STEPS)
    unseen = rows(3, 0.3)
    without = torch.mean((model.colour(unseen, torch.zeros(ROWS, 3)) - unseen.colour) ** 2)
    assert mean_squared_error(model, unseen) < 0.1 * float(without)
    ones = torch.ones(VERTICES, 3)
    in_lamp = FeatureRows(torch.arange(VERTICES), LAMP.expand(VERTICES, 3), ones, ones, ones[:, 0])
    added = model.added(in_lamp).mean(dim=1)
    assert float(added[IS_SHINY].min()) > 0.15
    assert float(added[~IS_SHINY].max()) < 0.05


def test_a_matte_surface_keeps_its_diffuse_colour() -> None:
    model = fit_feature(rows(2, 0.0), 0.5 * ALBEDO, 10.0, 0, STEPS)
    assert float((model.diffuse() - ALBEDO).abs().max()) < 0.02
    assert float(model.added(rows(3, 0.0)).max()) < 0.02


def test_the_weight_of_rows_counts() -> None:
    """A tenth of the rows, black and without weight, changes neither the fit nor the error."""
    good = rows(2, 0.0)
    weight = (torch.arange(ROWS) % 10 > 0).float()
    mixed = FeatureRows(good.vertex, good.direction, good.irradiance, good.colour * weight[:, None], weight)
    model = fit_feature(mixed, ALBEDO, 1e-1, 0, STEPS)
    assert mean_squared_error(model, mixed) < 1e-4


@pytest.mark.slow
def test_the_table_has_a_row_for_each_model(sample: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main([str(sample), "--frames", "16"])
    lines = capsys.readouterr().out.splitlines()
    names = ["colour", "colour + learnt feature", "light", "light + learnt feature", "light + lobe"]
    assert [line[:32].strip() for line in lines] == names
    assert all("held out" in line and "relit" in line for line in lines)
