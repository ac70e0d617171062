"""What a sweep found: one CSV line per trial, tables for the document, and small multiples."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from data_tools.stress.published import PublishedRow, read_published
from data_tools.stress.row import DONE, MISSING, Results, Row, TrialResult
from data_tools.sweep.chart_trials import format_origin, join_distinct, short_commit
from data_tools.sweep.runs import write_csv
from pipeline.core.atomic import atomic_path

Sweep = Mapping[str, Results]
"""Results by the name of the row."""

COLUMNS = ("row", "trial", "x", "state", "preset", "seconds", "score", "value", "commit", "machine", "message")
PANEL_INCHES, PANEL_COLUMNS = (4.0, 2.9), 4
VERDICT_COLOURS = {"pass": "#2a7f3f", "crossed": "#b3261e", "incomplete": "#8a6d00", MISSING: "#888888"}
MAX_SENTENCES = 6

TABLE_START, TABLE_END = "<!-- table: stress -->", "<!-- end of table -->"


def write_csv_table(path: Path, rows: Mapping[str, Row], sweep: Sweep) -> None:
    """Write one line for each score of each trial; a trial without scores has one line."""
    lines: list[Sequence[object]] = []
    for name, results in sweep.items():
        row = rows[name]
        for trial in row.trials:
            result = results[trial.label]
            scores: Sequence[tuple[str, object]] = list(result.scores.items()) or [("", "")]
            for score, value in scores:
                fixed = (name, trial.label, trial.x, result.state, row.preset, result.seconds)
                shown = "" if isinstance(value, float) and not math.isfinite(value) else value
                lines.append((*fixed, score, shown, result.commit, result.machine, result.message))
    write_csv(path, COLUMNS, lines)


def write_document(path: Path, rows: Mapping[str, Row], sweep: Sweep, command: str) -> None:
    """Replace the tables of the document between its marks; what stands around them stays.

    A row of which the document shows more finished trials than there are results here keeps its tables.

    Raises:
        ValueError: the document has no marks.
    """
    text = path.read_text(encoding="utf-8")
    before, start, rest = text.partition(TABLE_START)
    old, end, after = rest.partition(TABLE_END)
    if not start or not end:
        raise ValueError(f"{path} has no {TABLE_START} and {TABLE_END}")
    published = read_published(old)
    kept = {
        name: row for name, row in published.rows.items() if name in sweep and row.trials > len(_finished(sweep[name]))
    }
    sections = [kept[name].section if name in kept else trial_table(rows[name], sweep[name]) for name in sweep]
    tables = "\n".join([summary_table(rows, sweep, kept), *sections])
    origin = _provenance(sweep, kept, published.machines)
    with atomic_path(path) as part:
        part.write_text(f"{before}{start}\n\n{tables}\n{origin}; `{command}`.\n{end}{after}", "utf-8")


def summary_table(rows: Mapping[str, Row], sweep: Sweep, kept: Mapping[str, PublishedRow] | None = None) -> str:
    """Return the table of all rows: failure, pass line, verdict, number of trials and minutes.

    kept: rows whose line is that of the document.
    """
    lines = ["| row | failure | pass line | verdict | trials | minutes | preset | commit |", "|---" * 8 + "|"]
    for name, results in sweep.items():
        if kept and name in kept:
            lines.append(kept[name].summary)
            continue
        row = rows[name]
        verdict, _ = row.verdict(results)
        done = _finished(results)
        minutes = f"{sum(result.seconds for result in done) / 60:.0f}" if done else ""
        commit = join_distinct(short_commit(result.commit) for result in done)
        missing = f". Not made: {row.missing}" if row.missing else ""
        cells = (f"`{name}`", row.failure + missing, row.line, f"**{verdict}**")
        lines.append(
            "| " + " | ".join((*cells, f"{len(done)} of {len(row.trials)}", minutes, row.preset, commit)) + " |"
        )
    return "\n".join(lines) + "\n"


def trial_table(row: Row, results: Results) -> str:
    """Return the curve of a row with what was crossed, as Markdown; empty if nothing ran."""
    done = {label: result for label, result in results.items() if result.state != MISSING}
    if not done:
        return f"`{row.name}`: not run; `make stress ROWS={row.name}`.\n"
    verdict, crossed = row.verdict(results)
    lines = [
        f"`{row.name}`, {row.unit}: {verdict}.",
        "",
        f"| trial | {row.unit} | state | seconds |",
        "|---|---|---|---|",
    ]
    for label, result in done.items():
        value = result.scores.get(row.score)
        shown = "" if value is None else f"{value:.4g}"
        state = result.state if result.state == DONE else f"{result.state}: {_short_message(result.message)}"
        lines.append(f"| {label} | {shown} | {state} | {result.seconds:.0f} |")
    lines += ["", *(f"- {sentence}" for sentence in crossed[:MAX_SENTENCES])]
    if len(crossed) > MAX_SENTENCES:
        lines.append(f"- and {len(crossed) - MAX_SENTENCES} more, in `stress.csv`")
    return "\n".join(lines).rstrip() + "\n"


def draw_figure(rows: Mapping[str, Row], sweep: Sweep) -> Figure:
    """Draw one panel for each row that has a score: the sweep, coloured by its verdict. Equal results: equal figures.

    ValueError if no trial has the score of its row.
    """
    drawn = [name for name, results in sweep.items() if _points(rows[name], results)]
    if not drawn:
        raise ValueError("no row has a score")
    columns = min(PANEL_COLUMNS, len(drawn))
    height = math.ceil(len(drawn) / columns)
    figure = Figure(figsize=(PANEL_INCHES[0] * columns, PANEL_INCHES[1] * height), layout="constrained")
    grid = figure.subplots(height, columns, squeeze=False)
    for axes in grid.flat[len(drawn) :]:
        axes.set_axis_off()
    for axes, name in zip(grid.flat, drawn, strict=False):
        _draw_row(axes, rows[name], sweep[name])
    return figure


def _draw_row(axes: Axes, row: Row, results: Results) -> None:
    verdict, _ = row.verdict(results)
    colour = VERDICT_COLOURS[verdict]
    points = _points(row, results)
    positions = list(range(len(points)))
    axes.plot(positions, [value for _, value in points], "o-", color=colour, markersize=4, linewidth=1)
    axes.set_xticks(positions, [label for label, _ in points], rotation=35, ha="right", fontsize=6)
    axes.set_title(f"{row.name}: {verdict}", fontsize=9, loc="left", color=colour)
    axes.set_ylabel(row.unit, fontsize=7)
    axes.tick_params(axis="y", labelsize=7)
    axes.margins(x=0.08, y=0.2)
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)


def _points(row: Row, results: Results) -> list[tuple[str, float]]:
    """Return label and score of the finished trials in the order of the sweep."""
    values = [(trial.label, results[trial.label].scores.get(row.score, math.nan)) for trial in row.trials]
    return [(label, value) for label, value in values if math.isfinite(value)]


def _finished(results: Results) -> list[TrialResult]:
    return [result for result in results.values() if result.state != MISSING]


def _provenance(sweep: Sweep, kept: Mapping[str, PublishedRow], machines: str) -> str:
    """Return commits and machines of what is shown; `machines`: those of the document, of which the kept rows are."""
    done = [result for name, results in sweep.items() if name not in kept for result in _finished(results)]
    commits = [commit for row in kept.values() for commit in row.commits]
    own = [result.machine for result in done]
    return format_origin([*commits, *(result.commit for result in done)], [machines, *own] if kept else own)


def _short_message(message: str) -> str:
    """Return the start of a message without characters that end a table cell."""
    text = message.replace("|", "/")
    return text if len(text) <= 140 else f"{text[:137]}..."
