"""Options and settings of the field: what is refused, and how errors name it."""

from dataclasses import fields
from typing import Any

import pytest

from pipeline.core.config import ConfigLayers, build_config, default_yaml
from pipeline.core.errors import UserError
from pipeline.field.config import FieldConfig
from pipeline.field.settings import FieldSettings


def error_of(settings: Any) -> str:
    layers = ConfigLayers()
    layers.add({"field": {"settings": settings}}, "mine.yaml")
    with pytest.raises(UserError) as caught:
        build_config("field", FieldConfig, layers)
    return str(caught.value)


@pytest.mark.parametrize(("border", "outside"), [(0.0, 1.0), (1.0, 0.0), (0.7, 0.3), (0.9, 0.1)])
def test_sampling_ratios_may_add_up_to_one(border: float, outside: float) -> None:
    settings = FieldSettings(border_sampling_ratio=border, outside_sampling_ratio=outside)
    assert settings.outside_sampling_ratio == outside


@pytest.mark.parametrize(
    "settings",
    [
        {"border_sampling_ratio": 0.95},
        {"border_sampling_ratio": 0.6, "outside_sampling_ratio": 0.5},
    ],
)
def test_sampling_ratios_above_one_are_refused(settings: dict[str, float]) -> None:
    message = error_of(settings)
    assert message.startswith("mine.yaml: ")
    assert "border_sampling_ratio + outside_sampling_ratio must not exceed 1" in message


def test_contradicting_settings_are_refused_in_python_too() -> None:
    with pytest.raises(ValueError, match="max_clothing_offset_m .* min_clothing_offset_m"):
        FieldSettings(min_clothing_offset_m=0.2, max_clothing_offset_m=0.1)
    with pytest.raises(ValueError, match="levels"):
        FieldSettings(levels=17)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"tabel_learning_rate": 0.1}, ("tabel_learning_rate", "did you mean table_learning_rate?", "known: network")),
        ({"network": "transformer"}, ("field.settings.network = 'transformer'", "'hashgrid'", "'visual_hull'")),
        ({"huber_delta": -1.0}, ("field.settings.huber_delta = -1.0", "greater than 0")),
        ({"frames_per_step": 1.5}, ("field.settings.frames_per_step = 1.5",)),
        (3, ("field.settings = 3",)),
    ],
)
def test_a_wrong_setting_is_one_sentence(settings: Any, words: tuple[str, ...]) -> None:
    message = error_of(settings)
    assert all(word in message for word in words), message
    assert "\n" not in message


def test_settings_are_in_the_manifest_but_not_in_the_defaults() -> None:
    assert FieldConfig().model_dump(mode="json")["settings"].keys() == {
        setting.name for setting in fields(FieldSettings)
    }
    assert "settings" not in default_yaml({"field": FieldConfig})
