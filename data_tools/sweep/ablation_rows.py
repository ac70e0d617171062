"""Rows of the ablation of the mesh stage: each is the stage with one part removed, replaced or added."""

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
    """One variant of the mesh stage. Rows are compared by identity, because mappings have no hash.

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
