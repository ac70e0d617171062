"""Tables of the ablation: one line per run as CSV; means, spread and differences as Markdown and HTML."""

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from data_tools.sweep.ablation_rows import REFERENCE, ROWS
from data_tools.sweep.ablation_trials import FIGURE_PATHS, AblationResult, AblationTrial
from data_tools.sweep.chart_trials import format_origin
from data_tools.sweep.runs import write_csv
from data_tools.templates import render_template
from pipeline.core.atomic import atomic_path
from pipeline.report.templates import read_asset

Results = Mapping[AblationTrial, AblationResult]


@dataclass(frozen=True)
class Column:
    """A column of the tables: figure, heading, decimals, and the factor from the unit of the figure to that shown."""

    figure: str
    heading: str
    decimals: int
    factor: float = 1.0


COLUMNS = (
    Column("psnr_full_db", "held-out PSNR, dB", 2),
    Column("psnr_body_db", "body pixels, dB", 2),
    Column("novel_view_psnr_body_db", "novel views, body pixels, dB", 2),
    Column("chamfer_mm", "Chamfer, mm", 2),
    Column("normal_angle_deg", "normals, °", 2),
    Column("faces", "faces", 0),
    Column("texture_px", "texture, px", 0),
    Column("glb_bytes", "GLB, kB", 0, 1e-3),
    Column("rounds_kept", "rounds kept", 1),
    Column("mesh_seconds", "mesh stage, s", 0),
)
Table = tuple[str, list[str], list[list[str]]]
"""Title, headings and rows of cells."""


def write_tables(out: Path, results: Results, command: str) -> None:
    """Write ablation.csv, ablation.md and ablation.html; only finished runs are in the last two."""
    out.mkdir(parents=True, exist_ok=True)
    columns = ("capture", "preset", "row", "seed", "status", *FIGURE_PATHS, "commit", "machine", "message")
    lines = [
        [
            *(trial.base.capture_name, trial.base.preset_name, trial.row.name, trial.base.seed, result.status),
            *(result.figures.get(name) for name in FIGURE_PATHS),
            *(result.commit, result.machine, result.failure),
        ]
        for trial, result in results.items()
    ]
    write_csv(out / "ablation.csv", columns, lines)
    done = {trial: result for trial, result in results.items() if result.status == "done"}
    tables = [*capture_tables(done), *difference_tables(done)]
    note = f"{provenance(done)}; `{command}`."
    with atomic_path(out / "ablation.md") as path:
        path.write_text("\n".join([*map(markdown_table, tables), note, ""]), encoding="utf-8")
    page = render_template(
        "data_tools.sweep",
        "ablation.html.j2",
        style=read_asset("report.css"),
        tables=tables,
        note=note.replace("`", ""),
        rows=[row for row in ROWS.values() if any(trial.row == row for trial in done)],
        pictures=[(trial.run_dir.name, f"{trial.run_dir.name}/report/clay.jpg") for trial in _in_row_order(done)],
    )
    with atomic_path(out / "ablation.html") as path:
        path.write_text(page, encoding="utf-8")


def capture_tables(results: Results) -> list[Table]:
    """Return a table for each capture and preset: mean and standard deviation over the seeds."""
    tables = []
    for name in dict.fromkeys(_capture_label(trial) for trial in results):
        chosen = {trial: result for trial, result in results.items() if _capture_label(trial) == name}
        seeds = sorted({trial.base.seed for trial in chosen})
        rows = []
        for row in _row_names(chosen):
            figures = [result.figures for trial, result in chosen.items() if trial.row.name == row]
            rows.append([f"`{row}`", *(format_spread(_values(figures, column), column) for column in COLUMNS)])
        spread = (
            f"mean ± standard deviation, seeds {', '.join(map(str, seeds))}" if len(seeds) > 1 else f"seed {seeds[0]}"
        )
        title = f"{name}, {spread}"
        tables.append((title, ["row", *(column.heading for column in COLUMNS)], rows))
    return tables


def difference_tables(results: Results) -> list[Table]:
    """Return a table of the differences from `REFERENCE` on the same capture with the same seed; none without it."""
    references = {trial.base: result.figures for trial, result in results.items() if trial.row.name == REFERENCE}
    rows = []
    for row in _row_names(results):
        pairs = [
            (result.figures, references[trial.base])
            for trial, result in results.items()
            if trial.row.name == row != REFERENCE and trial.base in references
        ]
        if pairs:
            rows.append([f"`{row}`", str(len(pairs)), *(format_differences(pairs, column) for column in COLUMNS)])
    if not rows:
        return []
    title = f"Difference from `{REFERENCE}`, same capture and seed: mean, and least and greatest"
    return [(title, ["row", "pairs", *(column.heading for column in COLUMNS)], rows)]


def format_spread(values: Sequence[float], column: Column) -> str:
    """Format mean and standard deviation (of at least two values); empty without values."""
    if not values:
        return ""
    mean = f"{column.factor * statistics.fmean(values):,.{column.decimals}f}"
    if len(values) == 1:
        return mean
    return f"{mean} ± {column.factor * statistics.stdev(values):,.{column.decimals}f}"


def format_differences(pairs: Sequence[tuple[Mapping[str, float], Mapping[str, float]]], column: Column) -> str:
    """Format the mean difference of the pairs that have the figure, and the range if there are several."""
    name = column.figure
    values = [column.factor * (own[name] - other[name]) for own, other in pairs if name in own and name in other]
    if not values:
        return ""
    mean, low, high = (
        f"{value:+,.{column.decimals}f}" for value in (statistics.fmean(values), min(values), max(values))
    )
    return mean if len(values) == 1 else f"{mean} ({low} to {high})"


def markdown_table(table: Table) -> str:
    """Return a table as Markdown with its title above it."""
    title, headings, rows = table
    lines = [f"{title}:", "", *(f"| {' | '.join(cells)} |" for cells in (headings, ["---"] * len(headings), *rows))]
    return "\n".join([*lines, ""])


def provenance(results: Results) -> str:
    """Return commit and machine of the mesh stages, as one sentence part."""
    return format_origin(
        (result.commit for result in results.values()), (result.machine for result in results.values())
    )


def _values(figures: Sequence[Mapping[str, float]], column: Column) -> list[float]:
    return [values[column.figure] for values in figures if column.figure in values]


def _capture_label(trial: AblationTrial) -> str:
    return f"{trial.base.capture_name}, `{trial.base.preset_name}`"


def _row_names(results: Results) -> list[str]:
    used = {trial.row.name for trial in results}
    return [name for name in ROWS if name in used]


def _in_row_order(results: Results) -> list[AblationTrial]:
    """Return the trials with all rows of a capture and seed together, in the order of `ROWS`."""
    names = list(ROWS)
    bases = list(dict.fromkeys(trial.base for trial in results))
    return sorted(results, key=lambda trial: (bases.index(trial.base), names.index(trial.row.name)))
