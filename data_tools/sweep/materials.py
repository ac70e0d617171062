"""Measure light, albedo and highlights on synthetic captures over seeds, and write the table into docs/benchmarks.md.

python -m data_tools.sweep.materials CAPTURE ... [--mesh true run] [--seeds 0 1 2] [--out runs/materials] [--write-only]

`--mesh true`: true mesh, poses and masks, so that errors are those of the texture stage alone; nothing of it depends on
the seed but the changes of the exposure, so the first seed is used. `--mesh run`: whole runs; the seed enters from the
field stage on, and runs of one capture share frames and body. Figures of a trial are stored, so an interrupted sweep
continues, and stored again where the version of the texture stage has changed. A row of the table that was not measured
now stays as it is; each row names its commit.
"""

import argparse
import statistics
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from data_tools.command import run_command
from data_tools.sweep.chart_trials import Trial, describe_machine, join_distinct, read_trial, run_trial, short_commit
from data_tools.sweep.figures import MATERIALS, OWN_TABLES, insert_tables, read_table
from data_tools.sweep.material_trials import MaterialTrial, measure, read_figures
from data_tools.sweep.runs import RunState, log_path
from pipeline.core.command import format_module_command
from pipeline.core.errors import UserError
from pipeline.core.progress import track
from pipeline.core.status import FRESH

DOCUMENT = Path("docs/benchmarks.md")
STAGES_UNTIL_MESH = ("frames", "body", "field", "mesh")
TRUE, RUN = "true", "run"
Figures = Mapping[str, float]
RowKey = tuple[str, str]
"""Of a row of the table: capture and mesh."""


@dataclass(frozen=True)
class Column:
    """A column of the table: heading, decimals, and the value from the figures; None where it does not apply."""

    heading: str
    decimals: int
    value: Callable[[Figures], float | None]


def main(argv: Sequence[str]) -> None:
    """Measure what is missing, then write the table.

    Raises:
        UserError: a capture has no ground truth, a run failed, or figures are missing with `--write-only`.
    """
    options = _parse(argv)
    missing = [str(path) for path in options.captures if not (path / "truth").is_dir()]
    if missing:
        command = format_module_command("data_tools.sample", missing[0])
        raise UserError(f"{missing[0]} is no synthetic capture: make one, {command}")
    trials = trials_of(options.captures, options.mesh, options.seeds, options.preset, options.out)
    stored = {}
    for trial in track(trials, "trials"):
        figures = read_figures(trial)
        if figures is None and not options.write_only:
            finish_run(trial, trials)
            figures = measure(trial)
        if figures is not None:
            stored[trial] = figures
    if not stored:
        raise UserError(f"{options.out} has no figures: run the command without --write-only")
    text = DOCUMENT.read_text(encoding="utf-8")
    rows = published_rows(read_table(text, MATERIALS)) | material_rows(stored)
    table = "\n".join([*TABLE_HEAD, *(rows[key] for key in sorted(rows, key=lambda key: _order(key, rows)))]) + "\n"
    machines = join_distinct(describe_machine(each["environment"]) for each in stored.values())
    note = f"\nLast measured on {machines or 'an unknown machine'}: `make materials {_make_variables(options)}`.\n"
    DOCUMENT.write_text(insert_tables(text, {MATERIALS: table + note}, DOCUMENT, OWN_TABLES), encoding="utf-8")
    print(table)


def _make_variables(options: argparse.Namespace) -> str:
    chosen = {
        "CAPTURES": " ".join(map(str, options.captures)),
        "SEEDS": " ".join(map(str, options.seeds)),
        "ARGS": f"--mesh {' '.join(options.mesh)}",
    }
    return " ".join(f"{name}='{value}'" for name, value in chosen.items())


def _order(key: RowKey, rows: Mapping[RowKey, str]) -> tuple[int, bool]:
    """Captures in the order of their first rows, the true mesh before runs."""
    captures = list(dict.fromkeys(capture for capture, _ in rows))
    return captures.index(key[0]), key[1] != TRUE


def trials_of(
    captures: Sequence[Path], meshes: Sequence[str], seeds: Sequence[int], preset: str, out: Path
) -> list[MaterialTrial]:
    """Return the trials: of each capture one with the true mesh, and one a seed with runs."""
    trials = []
    for capture in captures:
        if TRUE in meshes:
            trials.append(MaterialTrial(Trial(capture, preset, seeds[0], out), true_mesh=True))
        if RUN in meshes:
            trials += [MaterialTrial(Trial(capture, preset, seed, out), true_mesh=False) for seed in seeds]
    return trials


def finish_run(trial: MaterialTrial, trials: Sequence[MaterialTrial]) -> None:
    """Run the stages that the figures of a run are made of; those after the mesh may be of another version."""
    if trial.true_mesh or _is_finished(read_trial(trial.base)):
        return
    run_trial(trial.base, [other.base for other in trials if not other.true_mesh])
    state = read_trial(trial.base)
    if not _is_finished(state):
        raise UserError(f"{trial.base.run_dir.name} is {state.status}: see {log_path(trial.base.run_dir)}")


def _is_finished(run: RunState) -> bool:
    return all(run.states[name] == FRESH for name in STAGES_UNTIL_MESH)


def _change(name: str) -> Callable[[Figures], float | None]:
    """Return by how much a figure is higher with the light removed."""
    return lambda figures: figures[f"{name}_auto"] - figures[f"{name}_kept"]


def _relit(figures: Figures) -> float:
    names = [name for name in figures if name.startswith("relit_") and name.endswith("_auto")]
    return statistics.fmean(figures[name] - figures[name.replace("_auto", "_kept")] for name in names)


def _gain_percent(figures: Figures) -> float | None:
    error = figures.get("gain_error_largest")
    return None if error is None else 100.0 * error


COLUMNS = (
    Column("albedo error, light kept", 1, lambda figures: figures["albedo_error_kept"]),
    Column("removed, %", 0, lambda figures: 100.0 * figures["albedo_error_auto"] / figures["albedo_error_kept"]),
    Column("relit, dB", 1, _relit),
    Column("held-out, dB", 1, _change("heldout_psnr_body_db")),
    Column("correlation", 2, lambda figures: figures.get("specular_correlation_auto")),
    Column("lamp, °", 0, lambda figures: figures.get("lamp_error_deg_auto")),
    Column("shiny regions", 0, lambda figures: figures["specular_regions"]),
    Column("gain, %", 1, _gain_percent),
    Column("normal map, °", 1, lambda figures: figures["normal_map_angle_deg"]),
    Column("seconds added", 0, lambda figures: figures["seconds_added"]),
)


HEADINGS = ("capture", "mesh", "seeds", *(column.heading for column in COLUMNS), "commit")
TABLE_HEAD = (f"| {' | '.join(HEADINGS)} |", "|---" * len(HEADINGS) + "|")


def material_rows(stored: Mapping[MaterialTrial, Mapping[str, Any]]) -> dict[RowKey, str]:
    """Return a row for each capture and mesh: the mean over seeds, least and greatest of several, and the commits.

    stored: of each trial, what `read_figures` returns.
    """
    groups: dict[RowKey, list[MaterialTrial]] = {}
    for trial in stored:
        groups.setdefault((trial.base.capture_name, TRUE if trial.true_mesh else RUN), []).append(trial)
    rows = {}
    for key, trials in groups.items():
        seeds = " ".join(str(trial.base.seed) for trial in trials)
        cells = [_cell(column, [stored[trial]["figures"] for trial in trials]) for column in COLUMNS]
        commits = join_distinct(short_commit(str(stored[trial]["commit"])) for trial in trials)
        rows[key] = f"| {' | '.join([*key, seeds, *cells, commits])} |"
    return rows


def published_rows(table: str) -> dict[RowKey, str]:
    """Return the rows of a table that was written before.

    Raises:
        UserError: the table has other columns than today's.
    """
    lines = [line for line in table.splitlines() if line.startswith("|")]
    if lines and tuple(lines[:2]) != TABLE_HEAD:
        raise UserError(
            f"{DOCUMENT}: the table {MATERIALS} has other columns than this version writes: "
            "remove its rows and measure all captures again"
        )
    return {(cells[1].strip(), cells[2].strip()): line for line in lines[2:] for cells in [line.split("|")]}


def _cell(column: Column, rows: Sequence[Figures]) -> str:
    values = [value for row in rows if (value := column.value(row)) is not None]
    if not values:
        return ""
    mean, low, high = (f"{each:.{column.decimals}f}" for each in (statistics.fmean(values), min(values), max(values)))
    return mean if low == high else f"{mean} ({low} to {high})"


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m data_tools.sweep.materials", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("captures", nargs="+", type=Path, help="folders of synthetic captures")
    parser.add_argument("--mesh", nargs="+", choices=(TRUE, RUN), default=[TRUE], help="true mesh, or runs")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2], help="seeds (default: 0 1 2)")
    parser.add_argument("--preset", default="instant", help="preset of the runs (default: instant)")
    parser.add_argument("--out", type=Path, default=Path("runs/materials"), help="folder of the runs and figures")
    parser.add_argument("--write-only", action="store_true", help="write the table of stored figures, measure nothing")
    return parser.parse_args(argv)


if __name__ == "__main__":
    raise SystemExit(run_command(main, sys.argv[1:]))
