"""Strict configuration: one section a stage, typed beside the stage's code, read from YAML and `--set`.

Later layers win: `configs/default.yaml`, then the preset's file, then the overrides (`--set mesh.resolution=256`).
Every value remembers the layer it came from, so that an error can name the place to mend.
"""

import difflib
import textwrap
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, is_dataclass
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic.fields import FieldInfo

from pipeline.core.errors import UserError

CONFIG_DIR = Path(__file__).resolve().parents[2] / "configs"
BASELINE_PRESETS = Path("data_tools", "baselines")
"""Folder of the presets that reproduce published methods, relative to the parent folder of the product's presets."""
TYPE_DESCRIPTIONS = {int: "a whole number", float: "a number", bool: "true or false", str: "text"}
YAML_WIDTH = 10_000
YAML_SCALAR_END = "...\n"
PRESET_SUFFIXES = (".yaml", ".yml")


class Config(BaseModel):
    """Base of a stage's options: frozen, unknown keys refused, no NaN or infinity.

    Each field is a `pydantic.Field` with its bounds and a description that names the unit.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, validate_default=True)


ConfigType = TypeVar("ConfigType", bound=Config)


@dataclass
class ConfigLayers:
    """The merged values of all sections, and for each dotted key the layer that set it."""

    values: dict[str, Any] = field(default_factory=dict)
    origin: dict[str, str] = field(default_factory=dict)

    def add(self, values: Mapping[str, Any], origin: str) -> None:
        """Lay `values` (a mapping per section) over what is there."""
        _merge(self.values, values)
        for key in _dotted_keys(values):
            self.origin[key] = origin

    def origin_of(self, key: str) -> str:
        """Name the layer that set `key` (dotted), or an ancestor of it."""
        while key not in self.origin and "." in key:
            key = key.rpartition(".")[0]
        return self.origin.get(key, "the defaults")


def load_layers(preset: str, overrides: Mapping[str, Any], config_dir: Path = CONFIG_DIR) -> ConfigLayers:
    """Read default.yaml, the preset (a name in `config_dir`, or a path to a YAML file) and the dotted overrides."""
    layers = ConfigLayers()
    default_path = config_dir / "default.yaml"
    if default_path.exists():
        layers.add(_read_sections(default_path), str(default_path))
    preset_path = find_preset(preset, config_dir)
    if preset_path != default_path:
        layers.add(_read_sections(preset_path), str(preset_path))
    for key, value in overrides.items():
        nested: Any = value
        for part in reversed(key.split(".")):
            nested = {part: nested}
        layers.add(nested, f"--set {key}")
    return layers


def preset_files(config_dir: Path = CONFIG_DIR) -> dict[str, Path]:
    """Return the file of every preset by name, sorted: those of `config_dir`, then those of published baselines."""
    folders = (config_dir, config_dir.parent / BASELINE_PRESETS)
    return {path.stem: path for folder in folders for path in sorted(folder.glob("*.yaml"))}


def find_preset(preset: str, config_dir: Path = CONFIG_DIR) -> Path:
    """Return the file of a preset given by name or by path; raise UserError that lists the known names."""
    files = preset_files(config_dir)
    path = Path(preset) if preset.endswith(PRESET_SUFFIXES) else files.get(preset, config_dir / f"{preset}.yaml")
    if not path.is_file() and preset != "default":
        raise UserError(f"preset {preset} is not known: use one of {', '.join(files)}, or the path of a .yaml file")
    return path


def parse_overrides(assignments: Iterable[str]) -> dict[str, Any]:
    """Turn `["mesh.resolution=256"]` into `{"mesh.resolution": 256}`; values are read as YAML."""
    overrides = {}
    for assignment in assignments:
        key, equals, text = assignment.partition("=")
        if not equals or len(key.split(".")) < 2 or not all(key.split(".")):
            raise UserError(f"--set {assignment} is not understood: write --set section.key=value")
        overrides[key] = _parse_yaml(text, f"--set {assignment}")
    return overrides


def check_sections(layers: ConfigLayers, known: Iterable[str]) -> None:
    """Refuse a section that belongs to no stage."""
    names = list(known)
    for name in layers.values:
        if name not in names:
            raise UserError(_unknown_key(layers.origin_of(name), name, "the configuration", names))


def build_config(section: str, config_type: type[ConfigType], layers: ConfigLayers) -> ConfigType:
    """Make the typed config of one section, or raise UserError: key, value, what is allowed, and where it was set."""
    values = layers.values.get(section) or {}
    try:
        return config_type.model_validate(values)
    except ValidationError as error:
        raise UserError(_format_validation_error(section, config_type, error.errors()[0], layers)) from None


def default_yaml(sections: Mapping[str, type[Config]]) -> str:
    """Render the defaults in code as the text of default.yaml, each key under its description."""
    lines = [
        "# The defaults of every stage: `make configs` writes this file from the code, a test holds the two equal."
    ]
    for section, config_type in sections.items():
        lines += ["", f"{section}:" if config_type.model_fields else f"{section}: {{}}"]
        defaults = config_type().model_dump(mode="json")
        for key, info in config_type.model_fields.items():
            if is_dataclass(info.annotation):  # settings without options of their own: only presets change them
                continue
            value = yaml.safe_dump(defaults[key], default_flow_style=True, sort_keys=False, width=YAML_WIDTH)
            lines += textwrap.wrap(info.description or "", 116, initial_indent="  # ", subsequent_indent="  # ")
            lines += [f"  {key}: {value.removesuffix(YAML_SCALAR_END).rstrip()}"]
    return "\n".join(lines) + "\n"


def _read_sections(path: Path) -> dict[str, Any]:
    sections = _parse_yaml(path.read_text(encoding="utf-8"), str(path)) or {}
    if not isinstance(sections, dict) or not all(isinstance(s, dict | None) for s in sections.values()):
        raise UserError(f"{path} is no configuration: it needs sections (stage names) with `key: value` lines inside")
    return {name: values or {} for name, values in sections.items()}


def _parse_yaml(text: str, origin: str) -> Any:
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError as error:
        problem = " ".join(str(error).split())
        raise UserError(f"{origin} is not valid YAML: {problem}") from None


def _merge(target: dict[str, Any], values: Mapping[str, Any]) -> None:
    for key, value in values.items():
        if isinstance(value, Mapping) and isinstance(target.get(key), dict):
            _merge(target[key], value)
        else:
            target[key] = _copied(value)


def _copied(value: Any) -> Any:
    return {key: _copied(inner) for key, inner in value.items()} if isinstance(value, Mapping) else value


def _dotted_keys(values: Mapping[str, Any], prefix: str = "") -> Iterable[str]:
    for key, value in values.items():
        yield f"{prefix}{key}"
        if isinstance(value, Mapping):
            yield from _dotted_keys(value, f"{prefix}{key}.")


def _format_validation_error(
    section: str, config_type: type[Config], error: Mapping[str, Any], layers: ConfigLayers
) -> str:
    """Say in one sentence what pydantic found: origin, key, value, what is allowed."""
    path = [str(part) for part in error["loc"]]
    dotted = ".".join([section, *path])
    origin = layers.origin_of(dotted)
    owner, info = _find_field(config_type, path)
    if error["type"] == "extra_forbidden":
        return _unknown_key(origin, dotted, ".".join([section, *path[:-1]]), list(owner.model_fields))
    place = "" if origin.startswith("--set") else f"{origin}: "
    if info is None:
        return f"{place}section {dotted} is not allowed: {error['msg']}"
    meaning = f" ({info.description})" if info.description else ""
    return (
        f"{place}{dotted} = {error['input']!r} is not allowed: it must be {_describe_constraints(info, error)}{meaning}"
    )


def _find_field(config_type: type[BaseModel], path: list[str]) -> tuple[type[BaseModel], FieldInfo | None]:
    """Walk down nested configs: the innermost model on `path`, and its field if `path` names one."""
    owner, info = config_type, None
    for part in path:
        if info is not None and isinstance(info.annotation, type) and issubclass(info.annotation, BaseModel):
            owner = info.annotation
        elif info is not None:
            break
        info = owner.model_fields.get(part)
    return owner, info


def _describe_constraints(info: FieldInfo, error: Mapping[str, Any]) -> str:
    """What a field takes, in words: its kind and limits; for other kinds, pydantic's own words."""
    words = {"gt": "above", "ge": "at least", "lt": "below", "le": "at most"}
    limits = [
        f"{word} {getattr(constraint, name)}"
        for constraint in info.metadata
        for name, word in words.items()
        if getattr(constraint, name, None) is not None
    ]
    kind = TYPE_DESCRIPTIONS.get(info.annotation) if isinstance(info.annotation, type) else None
    if kind is None or error["type"] in ("value_error", "assertion_error"):
        kind = error["msg"].removeprefix("Input should be ").removeprefix("Value error, ")
    return ", ".join([kind, *limits])


def _unknown_key(origin: str, key: str, section: str, known: list[str]) -> str:
    close = difflib.get_close_matches(key.rpartition(".")[2], known, n=1)
    hint = f" (did you mean {close[0]}?)" if close else ""
    place = "" if origin.startswith("--set") else f"{origin}: "
    return f"{place}{key} is no known key{hint}; known keys of {section}: {', '.join(known) or 'none'}"
