"""Options of stage one that depend on one another."""

import pytest

from pipeline.core.config import ConfigLayers, build_config
from pipeline.core.errors import UserError
from pipeline.field.config import FieldConfig


@pytest.mark.parametrize(("border", "outside"), [(0.0, 1.0), (1.0, 0.0), (0.7, 0.3), (0.9, 0.1)])
def test_shares_may_take_all_rays(border: float, outside: float) -> None:
    assert FieldConfig(border_sampling_ratio=border, outside_sampling_ratio=outside).outside_sampling_ratio == outside


@pytest.mark.parametrize(
    "shares", [{"border_sampling_ratio": 0.95}, {"border_sampling_ratio": 0.6, "outside_sampling_ratio": 0.5}]
)
def test_shares_that_take_more_than_all_rays_are_refused(shares: dict[str, float]) -> None:
    layers = ConfigLayers()
    layers.add({"field": shares}, "mine.yaml")
    with pytest.raises(UserError, match=r"mine.yaml: .*share_border and share_outside are together at most 1"):
        build_config("field", FieldConfig, layers)
