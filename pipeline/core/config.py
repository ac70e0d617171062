"""Strict configuration: one section for each stage, typed in the code of the stage, read from YAML and `--set`.

Later layers override earlier ones: `configs/default.yaml`, the file of the preset, the overrides
(`--set mesh.max_faces=30000`). Each value keeps the layer that set it, so that an error can name the place to correct.
"""

import difflib
import re
import textwrap
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, is_dataclass
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic.fields import FieldInfo

from pipeline.core.errors import UserError

CONFIG_DIR = Path(str(resources.files("configs")))
BASELINE_PRESETS = Path("data_tools", "baselines")
"""Folder of the presets that reproduce published methods, relative to the parent folder of the product's presets."""
PRESET_SUFFIXES = (".yaml", ".yml")
FILE_OPTION_SUFFIX = "_file"
"""End of the names of options that are paths of files."""

_NO_FILE = ("", "null")
_TYPE_DESCRIPTIONS = {int: "a whole number", float: "a number", bool: "true or false", str: "text"}
_YAML_WIDTH = 10_000
_YAML_BOOL, _YAML_DATE = "tag:yaml.org,2002:bool", "tag:yaml.org,2002:timestamp"
_YAML_SCALAR_END = "...\n"
_HEADING = "# Defaults of all stages. `make configs` writes this file from the code; a test compares the two."


class Config(BaseModel):
    """Base class of the options of a stage: frozen, without unknown keys, NaN or infinity.

    Each field is a `pydantic.Field` with its bounds and a description that names the unit.
    """

    model_config = ConfigDict(
        frozen=True, extra="forbid", allow_inf_nan=False, validate_default=True, coerce_numbers_to_str=True
    )


ConfigType = TypeVar("ConfigType", bound=Config)


@dataclass
class ConfigLayers:
    """Merged values by section and key, and the layer that set each dotted key."""

    values: dict[str, Any] = field(default_factory=dict)
    origins: dict[str, str] = field(default_factory=dict)

    def add(self, values: Mapping[str, Any], origin: str) -> None:
        """Override earlier values by `values`, which map each section to its keys."""
        _merge(self.values, values)
        self.origins |= dict.fromkeys(_dotted_keys(values), origin)

    def origin_of(self, key: str) -> str:
        """Return the name of the layer that set the dotted key or, if none did, the closest key that contains it."""
        while key not in self.origins and "." in key:
            key = key.rpartition(".")[0]
        return self.origins.get(key, "the defaults")


def load_layers(preset: str, overrides: Mapping[str, Any], config_dir: Path = CONFIG_DIR) -> ConfigLayers:
    """Read default.yaml, the preset and the overrides.

    Args:
        preset: name of a file in `config_dir`, or path of a YAML file.
        overrides: values by `section.key`, see `parse_overrides`.

    Raises:
        UserError: the preset does not exist, or a file is not valid.
    """
    layers = ConfigLayers()
    default_path = config_dir / "default.yaml"
    if default_path.exists():
        layers.add(_read_sections(default_path), str(default_path))
    preset_path = find_preset(preset, config_dir)
    if preset_path != default_path:
        layers.add(_read_sections(preset_path), str(preset_path))
    for dotted_key, value in overrides.items():
        nested = value
        for part in reversed(dotted_key.split(".")):
            nested = {part: nested}
        layers.add(nested, f"--set {dotted_key}")
    return layers


def preset_files(config_dir: Path = CONFIG_DIR) -> dict[str, Path]:
    """Return the file of every preset by name, sorted: those of `config_dir`, then those of published baselines."""
    folders = (config_dir, config_dir.parent / BASELINE_PRESETS)
    return {path.stem: path for folder in folders for path in sorted(folder.glob("*.yaml"))}


def find_preset(preset: str, config_dir: Path = CONFIG_DIR) -> Path:
    """Return the file of a preset, supplied as name or path.

    Raises:
        UserError: it does not exist; the message lists the known names.
    """
    files = preset_files(config_dir)
    path = Path(preset) if preset.endswith(PRESET_SUFFIXES) else files.get(preset, config_dir / f"{preset}.yaml")
    if preset.endswith(PRESET_SUFFIXES) and not path.is_file():
        raise UserError(f"preset {path} is {'a folder' if path.is_dir() else 'missing'}: name a .yaml file")
    if not path.is_file() and preset != "default":
        raise UserError(f"preset {preset} is unknown: use one of {', '.join(files)}, or the path of a .yaml file")
    return path


def parse_overrides(assignments: Iterable[str]) -> dict[str, Any]:
    """Convert `["mesh.max_faces=30000"]` to `{"mesh.max_faces": "30000"}`; `build_config` reads values by their types.

    An empty value, or null, of an option that is the path of a file becomes None.

    Raises:
        UserError: an assignment does not have the form section.key=value.
    """
    overrides = {}
    for assignment in assignments:
        key, equals, text = assignment.partition("=")
        parts = key.split(".")
        if not equals or len(parts) < 2 or not all(parts):
            raise UserError(f"--set {assignment} is not valid: write --set section.key=value")
        value = text.strip()
        overrides[key] = None if key.endswith(FILE_OPTION_SUFFIX) and value in _NO_FILE else value
    return overrides


def check_sections(layers: ConfigLayers, known: Iterable[str]) -> None:
    """Raise UserError for a section that belongs to no stage."""
    names = list(known)
    for name in layers.values:
        if name not in names:
            raise UserError(_format_unknown_key(layers.origin_of(name), name, "the configuration", names))


def build_config(section: str, config_type: type[ConfigType], layers: ConfigLayers) -> ConfigType:
    """Build the typed options of one section.

    A text is the value of an option that is text; for other types it is read as YAML, and an empty list may be nothing.

    Raises:
        UserError: a key or value is not valid; the message names the key, the value, what is allowed, and the layer.
    """
    try:
        fields, values = config_type.model_fields, layers.values.get(section) or {}
        types = {key: fields[key].annotation if key in fields else None for key in values}
        return config_type.model_validate({key: _read_value(value, types[key]) for key, value in values.items()})
    except ValidationError as error:
        raise UserError(_format_validation_error(section, config_type, error.errors()[0], layers)) from None


def default_yaml(sections: Mapping[str, type[Config]]) -> str:
    """Format the defaults in code as the text of default.yaml, each key after its description."""
    lines = [_HEADING]
    for section, config_type in sections.items():
        lines += ["", f"{section}:" if config_type.model_fields else f"{section}: {{}}"]
        defaults = config_type().model_dump(mode="json")
        for key, info in config_type.model_fields.items():
            if is_dataclass(info.annotation):  # constants of the method, which presets change and users do not
                continue
            value = yaml.safe_dump(defaults[key], default_flow_style=True, sort_keys=False, width=_YAML_WIDTH)
            lines += textwrap.wrap(info.description or "", 116, initial_indent="  # ", subsequent_indent="  # ")
            lines += [f"  {key}: {value.removesuffix(_YAML_SCALAR_END).rstrip()}"]
    return "\n".join(lines) + "\n"


def _read_sections(path: Path) -> dict[str, Any]:
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise UserError(f"{path} is not UTF-8 text ({error}): save it as UTF-8") from None
    sections = _parse_yaml(text, str(path)) or {}
    if not isinstance(sections, dict) or not all(isinstance(s, dict | None) for s in sections.values()):
        raise UserError(f"{path} is not a configuration: write sections (stage names) with `key: value` lines in them")
    return {name: values or {} for name, values in sections.items()}


def _read_value(value: Any, annotation: Any) -> Any:
    """Return the value of an option of a type: text that is not YAML stays text, which the check of the type names."""
    if isinstance(value, Mapping):
        return {key: _read_value(item, None) for key, item in value.items()}
    if not isinstance(value, str) or annotation is str or str in get_args(annotation):
        return value
    if not value and get_origin(annotation) is tuple:
        return []
    try:
        return yaml.load(value, _Loader)  # noqa: S506 - a safe loader
    except (yaml.YAMLError, ValueError, RecursionError):
        return value


def _parse_yaml(text: str, origin: str) -> Any:
    try:
        return yaml.load(text, _Loader)  # noqa: S506 - a safe loader
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        problem = " ".join(str(error).split())
        raise UserError(f"{origin} is not valid YAML: {problem}") from None


class _Loader(yaml.SafeLoader):
    """The safe loader without aliases: lists that share their parts have more items than fit into memory.

    As in YAML 1.2, only true and false are logical values (off and no are text), and a date is text.
    """

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        """Compose a node; YAMLError for an alias."""
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("aliases (*name) are not read: write the value again")
        node: yaml.Node | None = super().compose_node(parent, index)
        return node


_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag not in (_YAML_BOOL, _YAML_DATE)]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_Loader.add_implicit_resolver(_YAML_BOOL, re.compile("^(?:true|True|TRUE|false|False|FALSE)$"), list("tTfF"))


def _merge(target: dict[str, Any], values: Mapping[str, Any]) -> None:
    """Override `target` by `values`, mapping by mapping; `values` stay unchanged."""
    for key, value in values.items():
        if isinstance(value, Mapping):
            inner = target.get(key)
            target[key] = dict(inner) if isinstance(inner, Mapping) else {}
            _merge(target[key], value)
        else:
            target[key] = value


def _dotted_keys(values: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    for key, value in values.items():
        yield f"{prefix}{key}"
        if isinstance(value, Mapping):
            yield from _dotted_keys(value, f"{prefix}{key}.")


def _format_validation_error(
    section: str, config_type: type[Config], error: Mapping[str, Any], layers: ConfigLayers
) -> str:
    """Describe an error of pydantic in one sentence: layer, key, value, what is allowed."""
    path = [part for part in error["loc"] if isinstance(part, str)]  # users know a list, not the numbers of its items
    dotted_key = ".".join([section, *path])
    origin = layers.origin_of(dotted_key)
    fields = config_type.model_fields
    if error["type"] == "extra_forbidden" and path[0] not in fields:
        return _format_unknown_key(origin, dotted_key, section, list(fields))
    place = _format_place(origin)
    if not path:
        return f"{place}section {section} is not valid: {error['msg'].removeprefix('Value error, ')}"
    info = fields[path[0]]
    allowed = _describe_constraints(info, error)
    meaning = f" ({info.description})" if info.description else ""
    if error["type"] == "missing":  # an item of a list: options have defaults
        return f"{place}{dotted_key} = {error['input']!r} is not allowed: it has too few values{meaning}"
    is_item = len(path) < len(error["loc"])
    refused = f"contains {error['input']!r}, which" if is_item else f"= {error['input']!r}"
    return f"{place}{dotted_key} {refused} is not allowed: it must be {allowed}{meaning}"


def _describe_constraints(info: FieldInfo, error: Mapping[str, Any]) -> str:
    """Describe the values that a field allows: type and limits; for other types, the message of pydantic."""
    words = {"gt": "above", "ge": "at least", "lt": "below", "le": "at most", "min_length": "of a length of at least"}
    if error["type"] == "tuple_type":
        return "a list, written as [a, b]"
    limits = [
        f"{word} {getattr(constraint, name)}"
        for constraint in info.metadata
        for name, word in words.items()
        if getattr(constraint, name, None) is not None
    ]
    kind = _TYPE_DESCRIPTIONS.get(info.annotation) if isinstance(info.annotation, type) else None
    if kind is None or error["type"] in ("value_error", "assertion_error"):
        kind = error["msg"].removeprefix("Input should be ").removeprefix("Value error, ")
    return ", ".join([kind, *limits])


def _format_unknown_key(origin: str, key: str, section: str, known: list[str]) -> str:
    close = difflib.get_close_matches(key.rpartition(".")[2], known, n=1)
    hint = f" (did you mean {close[0]}?)" if close else ""
    return f"{_format_place(origin)}{key} is unknown{hint}; known keys of {section}: {', '.join(known) or 'none'}"


def _format_place(origin: str) -> str:
    """Return the prefix that names a file; an override on the command line is not a place to look for."""
    return "" if origin.startswith("--set") else f"{origin}: "
