"""Rows of the ablation of stage two: mesh or texture with one part removed, replaced or added, or one size changed."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from pipeline.mesh.settings import MeshSettings

REFERENCE = "error-driven"
"""The row that equals the stage as it is; the others are compared with it."""
FIELD_VIEWS = 40
FACES, FACES_BEFORE_REDUCTION = "faces", "faces_before_reduction"


@dataclass(frozen=True, eq=False)
class Row:
    """One variant of the stages from the mesh on. Rows are compared by identity, because mappings have no hash.

    Attributes:
        name: in command, tables and names of run folders.
        meaning: what differs from `REFERENCE`.
        options: options of the pipeline that differ, by `section.key`.
        settings: fields of `MeshSettings` that differ.
        from_reference: fields of `MeshSettings` that are metrics of the mesh stage of `REFERENCE`, same capture and
            seed: metric by field.
    """

    name: str
    meaning: str
    options: Mapping[str, Any] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)
    from_reference: Mapping[str, str] = field(default_factory=dict)

    @property
    def has_mesh_of_reference(self) -> bool:
        """Whether the mesh stage is that of `REFERENCE`: only later stages differ."""
        return bool(self.options) and not self.settings and all(key.startswith("texture.") for key in self.options)


def _texels(side_px: int) -> Row:
    limits = {"texture.min_texture_px": side_px, "texture.max_texture_px": side_px}
    return Row(f"texels-{side_px}", f"maps of {side_px} px instead of the size that the frames ask for", options=limits)


ROWS = {
    row.name: row
    for row in (
        Row("extracted", "surface of the field, faired; no round of refinement", options={"mesh.rounds": 0}),
        Row("vertices-only", "vertices are optimised in all rounds, faces stay", settings={"remeshing": "none"}),
        Row(
            "uniform",
            "uniform edge length in all rounds, and as many faces as error-driven at the end; no reduction",
            settings={"remeshing": "uniform"},
            from_reference={"remeshed_faces": FACES, "final_faces": FACES},
        ),
        Row(
            "uniform-reduced",
            "uniform edge length, with as many faces as error-driven before its reduction, then reduced to as many",
            settings={"remeshing": "uniform"},
            from_reference={"remeshed_faces": FACES_BEFORE_REDUCTION, "final_faces": FACES},
        ),
        Row(REFERENCE, "the stage as it is: remeshed by the image error, then reduced"),
        Row("no-global-offset", "without the offset of all vertices", settings={"global_learning_rate": 0.0}),
        Row("no-pose-alignment", "poses are not aligned to the surface", settings={"alignment_steps": 0}),
        Row(
            "field-views",
            f"with {FIELD_VIEWS} renders of the field from other cameras as training views",
            settings={"field_views": FIELD_VIEWS},
        ),
        Row("faces-7000", "at most 7,000 faces, whatever it costs", options={"mesh.max_final_faces": 7000}),
        Row("faces-29000", "at most 29,000 faces: twice the limit", options={"mesh.max_final_faces": 29_000}),
        *map(_texels, (512, 1024, 2048)),
    )
}


def row_settings(row: Row, seed: int, reference_metrics: Mapping[str, float | None]) -> dict[str, Any]:
    """Return the fields of `MeshSettings` for a row and a seed that differ from the defaults.

    reference_metrics: metrics of the mesh stage of `REFERENCE`; may be empty if `row.from_reference` is.

    Raises:
        KeyError, ValueError: a metric is missing, or a value is refused by `MeshSettings`.
    """
    numbers = {name: int(reference_metrics[metric] or 0) for name, metric in row.from_reference.items()}
    settings = {"seed": seed, **row.settings, **numbers}
    MeshSettings(**settings)
    return settings
