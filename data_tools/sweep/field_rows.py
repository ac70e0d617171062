"""Rows of the sweep of the field stage: each differs from the stage as it is in one size or one part."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from pipeline.field.config import FieldConfig
from pipeline.field.settings import FieldSettings

REFERENCE = "reference"
SIZE, ATTENTION, LOSS = "size", "attention", "loss"
GROUPS = (SIZE, ATTENTION, LOSS)
DEFAULTS = FieldSettings()
SQUARED = {"huber_delta": 1.0} | {
    name: getattr(DEFAULTS, name) * DEFAULTS.huber_delta
    for name in ("hard_surface_weight", "empty_density_weight", "pose_smoothness_weight", "pose_l2_weight")
}
"""Losses that are quadratic for every difference of two colours, as steep near zero beside the other losses: a Huber
loss is divided by its delta."""
SMALL_PERSON_PX = 240


@dataclass(frozen=True, eq=False)
class FieldRow:
    """One variant of the field stage. Rows are compared by identity, because mappings have no hash.

    Attributes:
        name: in command, tables and names of folders.
        meaning: what differs from `compared_with`.
        group: rows that are asked for together.
        factors: factor of an integer option of the stage, by name.
        settings: fields of `FieldSettings` that differ.
        options: options of the stage that differ.
        compared_with: name of the row whose scores are subtracted in the tables of differences.
    """

    name: str
    meaning: str
    group: str = SIZE
    factors: Mapping[str, float] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)
    options: Mapping[str, Any] = field(default_factory=dict)
    compared_with: str = REFERENCE

    def config(self, base: FieldConfig) -> FieldConfig:
        """Return the options of this row, from those of the reference.

        Raises:
            ValueError: an option or setting is refused.
        """
        scaled = {name: round(getattr(base, name) * factor) for name, factor in self.factors.items()}
        values = {name: getattr(base, name) for name in type(base).model_fields}
        changed = {"settings": replace(base.settings, **self.settings), **self.options, **scaled}
        return FieldConfig(**(values | changed))


SMALL = "small-person"
_SMALL_OPTIONS = {"max_person_px": SMALL_PERSON_PX}

ROWS = {
    row.name: row
    for row in (
        FieldRow(REFERENCE, "the stage as it is"),
        FieldRow("rows-half", "half the rows of the hash table", options={"log2_hashmap_size": 16}),
        FieldRow("rows-quarter", "a quarter of the rows", options={"log2_hashmap_size": 15}),
        FieldRow("rows-double", "twice the rows", options={"log2_hashmap_size": 18}),
        FieldRow("levels-less", "one level less, same finest cell", settings={"levels": DEFAULTS.levels - 1}),
        FieldRow("levels-more", "one level more, same finest cell", settings={"levels": DEFAULTS.levels + 1}),
        FieldRow("width-half", "half the units of the hidden layer", settings={"hidden_width": 16}),
        FieldRow("width-double", "twice the units", settings={"hidden_width": 64}),
        FieldRow("steps-half", "half the steps", factors={"steps": 0.5}),
        FieldRow("steps-double", "twice the steps", factors={"steps": 2.0}),
        FieldRow("frames-half", "half of the training frames", factors={"max_frames": 0.5}),
        FieldRow("frames-quarter", "a quarter of the training frames", factors={"max_frames": 0.25}),
        FieldRow(SMALL, f"person at most {SMALL_PERSON_PX} px tall", options=_SMALL_OPTIONS),
        FieldRow(
            "small-person-rows-quarter",
            "the same, with a quarter of the rows",
            options={**_SMALL_OPTIONS, "log2_hashmap_size": 15},
            compared_with=SMALL,
        ),
        FieldRow(
            "small-person-rows-eighth",
            "the same, with an eighth of the rows",
            options={**_SMALL_OPTIONS, "log2_hashmap_size": 14},
            compared_with=SMALL,
        ),
        FieldRow("squared", "squared instead of Huber losses", group=LOSS, settings=SQUARED),
        FieldRow("no-alpha", "without the loss of alpha", group=LOSS, settings={"alpha_weight": 0.0}),
        FieldRow("no-hard-surface", "without the hard-surface loss", group=LOSS, settings={"hard_surface_weight": 0.0}),
        FieldRow(
            "no-density",
            "without the loss of density in empty space",
            group=LOSS,
            settings={"empty_density_weight": 0.0},
        ),
        FieldRow(
            "pixel-jitter", "rays through random points of the pixels", group=LOSS, settings={"pixel_jitter": True}
        ),
        FieldRow("attention", "voxel attention", group=ATTENTION, settings={"occupancy": "attention"}),
    )
}


def rows_of_group(group: str) -> list[str]:
    """Return the names of the reference and of the rows of a group."""
    return [name for name, row in ROWS.items() if name == REFERENCE or row.group == group]
