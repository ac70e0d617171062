"""Strict configuration: order of the layers, and errors that name the place to correct in one sentence."""

from pathlib import Path
from typing import Literal, Self

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from pydantic import Field, field_validator, model_validator

from pipeline.core.config import (
    Config,
    ConfigLayers,
    build_config,
    check_sections,
    default_yaml,
    load_layers,
    parse_overrides,
    preset_files,
)
from pipeline.core.errors import UserError


class Options(Config):
    size: int = Field(64, ge=16, le=256, description="cells along the longest side")
    kind: Literal["fast", "fine"] = Field("fast", description="speed or quality")
    name: str = Field("x", description="a name")
    sides_m: tuple[float, float] = Field((1.0, 2.0), description="metres")
    words: tuple[Literal["fast", "fine"], ...] = Field((), description="a list")
    rate: float = Field(0.1, gt=0, le=1, description="learning rate, per step")
    note: str | None = Field(None, description="a note")
    author: str = Field("x", min_length=1, description="a person")

    @model_validator(mode="after")
    def _check_name(self) -> Self:
        if self.name == "huge" and self.size < 100:
            raise ValueError("name = huge needs size >= 100")
        return self

    @field_validator("name")
    @classmethod
    def _no_spaces(cls, name: str) -> str:
        if " " in name:
            raise ValueError("text without spaces")
        return name


@pytest.fixture
def config_dir(tmp_path: Path) -> Path:
    folder = tmp_path / "configs"
    folder.mkdir()
    (folder / "default.yaml").write_text("mesh:\n  size: 100\n  name: base\n")
    (folder / "fine.yaml").write_text("mesh:\n  size: 200\n  rate: 1e-2\n")
    return folder


def built(config_dir: Path, preset: str = "default", *assignments: str) -> Options:
    return build_config("mesh", Options, load_layers(preset, parse_overrides(assignments), config_dir))


def config_error_message(config_dir: Path, preset: str, *assignments: str) -> str:
    with pytest.raises(UserError) as caught:
        built(config_dir, preset, *assignments)
    return str(caught.value)


def test_later_layers_win(config_dir: Path) -> None:
    assert built(config_dir).size == 100
    fine = built(config_dir, "fine", "mesh.kind=fine", "mesh.rate=0.5")
    assert (fine.size, fine.name, fine.kind, fine.rate) == (200, "base", "fine", 0.5)


def test_yaml_numbers_without_a_dot_are_numbers(config_dir: Path) -> None:
    assert built(config_dir, "fine").rate == 0.01


@pytest.mark.parametrize(
    ("assignment", "words"),
    [
        ("mesh.size=8", ("mesh.size = 8", "a whole number, at least 16, at most 256", "cells along the longest side")),
        ("mesh.size=abc", ("mesh.size = 'abc'", "a whole number")),
        ("mesh.size=1.5", ("mesh.size = 1.5", "a whole number")),
        ("mesh.kind=slow", ("mesh.kind = 'slow'", "'fast' or 'fine'")),
        ("mesh.name=a b", ("mesh.name = 'a b'", "text without spaces")),
        ("mesh.rate=.nan", ("mesh.rate = nan", "a number, above 0, at most 1", "per step")),
        ("mesh.rate=2", ("mesh.rate = 2", "above 0, at most 1")),
        ("mesh.sides_m=[1, x]", ("mesh.sides_m contains 'x', which is not allowed: it must be a valid number",)),
        ("mesh.sides_m=[1]", ("mesh.sides_m = [1] is not allowed: it has too few values (metres)",)),
        ("mesh.sides_m=[1, 2, 3]", ("mesh.sides_m = [1, 2, 3] is not allowed", "at most 2")),
        ("mesh.words=[fast, slow]", ("mesh.words contains 'slow', which is not allowed: it must be 'fast' or 'fine'",)),
        (
            "mesh.sizes=8",
            ("mesh.sizes is unknown", "did you mean size?", "size, kind, name, sides_m, words, rate, note"),
        ),
        ("mesh.rat=8", ("mesh.rat is unknown", "did you mean rate?")),
        ("mesh.size.a=8", ("mesh.size = {'a': 8}", "a whole number")),
        ("mesh.size={a: 8}", ("mesh.size = {'a': 8}", "a whole number")),
        ("mesh.size=[1", ("mesh.size = '[1'", "a whole number")),
        ("mesh.sides_m=1, 2", ("mesh.sides_m = '1, 2'", "a list, written as [a, b] (metres)")),
        ("mesh.sides_m=[1, 2", ("mesh.sides_m = '[1, 2'", "a list, written as [a, b] (metres)")),
        ("mesh.sides_m=", ("mesh.sides_m = [] is not allowed: it has too few values (metres)",)),
        ("mesh.author=", ("mesh.author = ''", "it must be text, of a length of at least 1 (a person)")),
    ],
)
def test_a_bad_value_is_one_sentence(config_dir: Path, assignment: str, words: tuple[str, ...]) -> None:
    sentence = config_error_message(config_dir, "default", assignment)
    assert all(word in sentence for word in words), sentence
    assert "\n" not in sentence


def test_options_that_contradict_each_other_are_named(config_dir: Path) -> None:
    sentence = config_error_message(config_dir, "default", "mesh.name=huge", "mesh.size=64")
    assert sentence == "section mesh is not valid: name = huge needs size >= 100"


def test_a_bad_value_in_a_file_names_the_file(config_dir: Path) -> None:
    (config_dir / "odd.yaml").write_text("mesh:\n  size: 8\n")
    assert config_error_message(config_dir, "odd").startswith(str(config_dir / "odd.yaml"))
    (config_dir / "odd.yaml").write_text("mesh:\n  sice: 8\n")
    assert config_error_message(config_dir, "odd").startswith(f"{config_dir / 'odd.yaml'}: mesh.sice")


def test_the_layer_of_a_value_is_the_last_that_sets_it(config_dir: Path) -> None:
    layers = load_layers("fine", {"mesh.size": 3}, config_dir)
    assert layers.origin_of("mesh.size") == "--set mesh.size"
    assert layers.origin_of("mesh.name") == str(config_dir / "default.yaml")


@pytest.mark.parametrize("text", ["mesh: [1, 2", "- a\n- b\n", "mesh: 3\n", "just words"])
def test_a_broken_file_is_named(config_dir: Path, text: str) -> None:
    (config_dir / "broken.yaml").write_text(text)
    with pytest.raises(UserError, match=r"broken\.yaml"):
        load_layers("broken", {}, config_dir)


@pytest.mark.parametrize("assignment", ["mesh.size", "size=3", ".size=3", "mesh.=3"])
def test_a_broken_assignment_is_named(assignment: str) -> None:
    with pytest.raises(UserError, match="--set"):
        parse_overrides([assignment])


def test_an_unknown_preset_lists_the_known(config_dir: Path) -> None:
    with pytest.raises(UserError, match="default, fine"):
        load_layers("fien", {}, config_dir)


def test_a_preset_may_be_a_baseline(config_dir: Path) -> None:
    folder = config_dir.parent / "data_tools" / "baselines"
    folder.mkdir(parents=True)
    (folder / "paper.yaml").write_text("mesh:\n  size: 50\n")
    assert built(config_dir, "paper").size == 50
    assert list(preset_files(config_dir)) == ["default", "fine", "paper"]


def test_a_preset_file_that_cannot_be_read_is_named(config_dir: Path) -> None:
    (config_dir / "folder.yaml").mkdir()
    for name, words in (("none.yaml", "none.yaml is missing"), ("folder.yaml", "folder.yaml is a folder")):
        with pytest.raises(UserError, match=words):
            load_layers(str(config_dir / name), {}, config_dir)


def test_a_preset_may_be_a_path(config_dir: Path) -> None:
    assert built(config_dir, str(config_dir / "fine.yaml")).size == 200


def test_an_unknown_section_lists_the_known() -> None:
    layers = ConfigLayers()
    layers.add({"mehs": {"size": 1}}, "--set mehs.size")
    with pytest.raises(UserError, match=r"did you mean mesh\?.*known keys of the configuration: body, mesh"):
        check_sections(layers, ["body", "mesh"])


def test_configs_are_frozen() -> None:
    with pytest.raises(ValueError, match="frozen"):
        Options().size = 3  # type: ignore[misc]


def test_default_yaml_reads_back_as_the_defaults() -> None:
    text = default_yaml({"mesh": Options, "empty": Config})
    values = yaml.safe_load(text)
    assert Options.model_validate(values["mesh"]) == Options()
    assert values["empty"] == {}
    assert "  # cells along the longest side\n  size: 64\n" in text


@pytest.mark.parametrize(
    "text",
    ["Shot #3, for the museum", "Only for X: ask", "@jane", "off", "2024-01-02", "- a", "%", "a: b: c", "x #", "#me"]
    + ["", "007", "1.50", "2024", "true", "null", "~", "[draft] ask me", "[a, b]", "{", "&a", "!b", "'", '"a" and b'],
)
def test_text_is_taken_as_it_is(config_dir: Path, text: str) -> None:
    assert built(config_dir, "default", f"mesh.note={text}").note == text
    if text:
        assert built(config_dir, "default", f"mesh.author={text}").author == text


@pytest.mark.parametrize(("text", "words"), [("", ()), ("[]", ()), ("[fast, fine]", ("fast", "fine"))])
def test_a_list_may_be_empty(config_dir: Path, text: str, words: tuple[str, ...]) -> None:
    assert built(config_dir, "default", f"mesh.words={text}").words == words


@given(st.integers(16, 256))
def test_numbers_are_read_by_the_type_of_the_option(number: int) -> None:
    layers = ConfigLayers()
    layers.add({"mesh": {"size": str(number), "rate": f"1e-{number % 9}"}}, "--set")
    options = build_config("mesh", Options, layers)
    assert (options.size, options.rate) == (number, float(f"1e-{number % 9}"))


@pytest.mark.parametrize("text", ["", "null"])
def test_the_path_of_a_file_can_be_removed(text: str) -> None:
    assert parse_overrides([f"body.model_file={text}", f"body.x={text}"]) == {"body.model_file": None, "body.x": text}


@pytest.mark.parametrize(
    "text",
    [
        "mesh: &m\n  rounds: 2\nfield: *m\n",
        "mesh:\n  rounds: " + "9" * 5000,
        "mesh: " + "[" * 5000,
        "mesh: !!python/object/apply:os.getcwd []",
    ],
)
def test_yaml_that_is_more_than_values_is_refused(config_dir: Path, text: str) -> None:
    """Aliases that share lists could have more items than fit into memory; tags could run code."""
    (config_dir / "odd.yaml").write_text(text)
    with pytest.raises(UserError, match=r"odd\.yaml is not valid YAML"):
        load_layers(str(config_dir / "odd.yaml"), {}, config_dir)


def test_a_preset_that_is_no_text_is_refused(config_dir: Path) -> None:
    (config_dir / "odd.yaml").write_bytes(b"mesh:\n  rounds: \xff\n")
    with pytest.raises(UserError, match=r"odd\.yaml is not UTF-8 text"):
        load_layers(str(config_dir / "odd.yaml"), {}, config_dir)
