"""The presets in configs/ agree with the options of the stages."""

from pathlib import Path

import pytest

from pipeline.core.config import CONFIG_DIR, default_yaml, preset_files
from pipeline.core.record import RunRecord
from stages import PIPELINE, STAGES, load_stage

PRESETS = list(preset_files())


def test_the_presets_are_there() -> None:
    baselines = {"instantavatar", "ihm", "animnerf", "visual-hull"}
    assert {"default", "fine", "instant", "smoke"} | baselines <= set(PRESETS)


def test_default_yaml_equals_the_defaults_in_code() -> None:
    written = (CONFIG_DIR / "default.yaml").read_text(encoding="utf-8")
    assert written == default_yaml({name: load_stage(name).config for name in STAGES}), "run: make configs"


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_is_allowed(preset: str) -> None:
    configs = PIPELINE.build_configs(RunRecord(preset=preset))
    assert list(configs) == list(STAGES)


@pytest.mark.parametrize("name", STAGES)
def test_a_stage_has_one_name_in_all_places(name: str, repository: Path) -> None:
    assert load_stage(name).name == name
    assert (repository / "stages" / f"{name}.py").is_file()
    assert f"\n{name}:" in (CONFIG_DIR / "default.yaml").read_text()
    assert name in next(line for line in (repository / "Makefile").read_text().splitlines() if "STAGES :=" in line)


@pytest.mark.parametrize("name", STAGES)
def test_a_stage_reads_only_what_comes_before_it(name: str) -> None:
    assert set(load_stage(name).needs) <= {"video", *STAGES[: STAGES.index(name)]}


@pytest.mark.parametrize("name", STAGES)
def test_every_option_says_what_it_means(name: str) -> None:
    fields = load_stage(name).config.model_fields
    assert [key for key, info in fields.items() if not info.description] == []
