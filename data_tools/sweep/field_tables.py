"""Tables of the sweep of the field stage: one line per training as CSV; means and paired differences as Markdown."""

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from data_tools.sweep.chart_trials import format_origin
from data_tools.sweep.field_rows import ROWS
from data_tools.sweep.field_trials import FieldTrial, TrialScores
from data_tools.sweep.runs import write_csv
from pipeline.core.atomic import atomic_path

Results = Mapping[FieldTrial, TrialScores]


@dataclass(frozen=True)
class Column:
    """A column: score, heading, decimals, and the factor from the unit of the score to the one shown."""

    score: str
    heading: str
    decimals: int
    factor: float = 1.0


COLUMNS = (
    Column("validation_psnr_db", "validation, dB", 2),
    Column("validation_psnr_body_db", "body pixels, dB", 2),
    Column("novel_view_psnr_db", "novel views, dB", 2),
    Column("novel_view_psnr_body_db", "body, dB", 2),
    Column("novel_pose_psnr_db", "novel poses, dB", 2),
    Column("novel_pose_psnr_body_db", "body, dB", 2),
    Column("haze", "haze, alpha × 1e6", 1, 1e6),
    Column("field_chamfer_mm", "Chamfer, mm", 2),
    Column("field_normal_angle_deg", "normals, °", 2),
    Column("samples_per_step", "samples a step", 0),
    Column("train_frames", "frames", 0),
    Column("parameters", "parameters, thousands", 0, 1e-3),
    Column("cpu_seconds", "CPU, s", 1),
)
VALIDATION_COLUMNS = COLUMNS[:2]


def write_tables(out: Path, results: Results, command: str) -> None:
    """Write field.csv and field.md."""
    out.mkdir(parents=True, exist_ok=True)
    names = [column.score for column in COLUMNS]
    lines = [
        [
            *(trial.run.name, trial.row.name, trial.seed, trial.config.steps),
            *(result.scores.get(name) for name in (*names, "seconds")),
            *(result.commit, result.machine),
        ]
        for trial, result in results.items()
    ]
    write_csv(out / "field.csv", ("run", "row", "seed", "steps", *names, "seconds", "commit", "machine"), lines)
    commits, machines = [result.commit for result in results.values()], [result.machine for result in results.values()]
    tables = [markdown_means(results), markdown_differences(results), markdown_differences_by_run(results)]
    text = [*tables, f"{format_origin(commits, machines)}; `{command}`."]
    with atomic_path(out / "field.md") as path:
        path.write_text("\n\n".join(text) + "\n", encoding="utf-8")


def markdown_means(results: Results) -> str:
    """Return a table with the mean of each score over runs and seeds, one line per row of the sweep."""
    columns = _columns(results)
    lines = []
    for name in _row_names(results):
        chosen = [result.scores for trial, result in results.items() if trial.row.name == name]
        cells = (format_mean(chosen, column) for column in columns)
        lines.append([f"`{name}`", ROWS[name].meaning, str(len(chosen)), *cells])
    return _table(["row", "what differs", "n", *(column.heading for column in columns)], lines)


def markdown_differences(results: Results) -> str:
    """Return a table of the differences from the compared row, same run and seed: mean and its standard error."""
    columns = _columns(results)
    lines = []
    for name in _row_names(results):
        pairs = paired_scores(results, name)
        if pairs:
            cells = (format_difference(pairs, column) for column in columns)
            lines.append([f"`{name}` - `{ROWS[name].compared_with}`", str(len(pairs)), *cells])
    return _table(["difference", "n", *(column.heading for column in columns)], lines) if lines else ""


def markdown_differences_by_run(results: Results) -> str:
    """Return a table of the differences of the validation PSNR, whole image / body pixels, a column for each run."""
    runs = list(dict.fromkeys(trial.run.name for trial in results))
    lines = []
    for name in _row_names(results):
        cells = []
        for run in runs:
            pairs = paired_scores({t: scores for t, scores in results.items() if t.run.name == run}, name)
            cells.append(" / ".join(format_difference(pairs, column) for column in VALIDATION_COLUMNS))
        if any(cell.strip("– /") for cell in cells):
            lines.append([f"`{name}` - `{ROWS[name].compared_with}`", *cells])
    return _table(["difference", *(f"{run}, dB" for run in runs)], lines) if lines else ""


def paired_scores(results: Results, name: str) -> list[tuple[Mapping[str, float], Mapping[str, float]]]:
    """Return the scores of a row with those of the row that it is compared with, same run and seed."""
    base = ROWS[name].compared_with
    references = {(trial.run, trial.seed): result.scores for trial, result in results.items() if trial.row.name == base}
    return [
        (result.scores, references[trial.run, trial.seed])
        for trial, result in results.items()
        if trial.row.name == name != base and (trial.run, trial.seed) in references
    ]


def format_difference(pairs: Sequence[tuple[Mapping[str, float], Mapping[str, float]]], column: Column) -> str:
    """Return the mean difference with its sign and, from two pairs on, its standard error; a dash without pairs.

    Pairs of which one lacks the score are left out.
    """
    known = [pair for pair in pairs if all(column.score in scores for scores in pair)]
    values = [column.factor * (scores[column.score] - reference[column.score]) for scores, reference in known]
    if not values:
        return "–"
    mean = f"{statistics.fmean(values):+.{column.decimals}f}"
    if len(values) < 2:
        return mean
    return f"{mean} ± {statistics.stdev(values) / math.sqrt(len(values)):.{column.decimals}f}"


def format_mean(trainings: Sequence[Mapping[str, float]], column: Column) -> str:
    """Return the mean over the trainings that have the score; a dash if none has."""
    values = [column.factor * scores[column.score] for scores in trainings if column.score in scores]
    return f"{statistics.fmean(values):,.{column.decimals}f}" if values else "–"


def _columns(results: Results) -> list[Column]:
    """Return the columns that at least one training has."""
    return [column for column in COLUMNS if any(column.score in result.scores for result in results.values())]


def _row_names(results: Results) -> list[str]:
    return list(dict.fromkeys(trial.row.name for trial in results))


def _table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [headings, ["---"] * len(headings), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
