"""Measure every table of README.md and docs/ on one commit, and write the tables into the documents.

python -m data_tools.sweep.figures [CAPTURE ...] [--presets instant default fine] [--out runs/figures] [--write-only]

Runs are made as by `data_tools.sweep.chart`, so an interrupted sweep continues. A table replaces the lines between
`<!-- figures: NAME -->` and `<!-- end of figures -->`. Runs of more than one commit are refused.
"""

import argparse
import json
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import stages
from data_tools.command import run_command
from data_tools.sweep.chart import run_and_compare
from data_tools.sweep.chart_trials import STAGES_UNTIL_EXPORT, Trial, read_trial, short_commit, table_row
from data_tools.sweep.runs import RunState
from pipeline.core.errors import UserError
from pipeline.core.progress import track

DOCUMENTS = (Path("README.md"), Path("docs/benchmarks.md"))
CAPTURES = (Path("runs/sample-capture"),)
PRESETS = ("instant", "default", "fine")
OWN_TABLES, MATERIALS = ("presets", "stages"), "materials"
"""Tables that this command writes, and that of `data_tools.sweep.materials`."""

END = "<!-- end of figures -->"


def main(argv: Sequence[str]) -> None:
    """Run what is missing, then write the tables.

    Raises:
        UserError: a capture does not exist, a run failed, or the runs are of different commits.
    """
    options = _parse(argv)
    captures = options.captures or list(CAPTURES)
    missing = [str(path) for path in captures if not path.exists()]
    if missing:
        raise UserError(f"{missing[0]} does not exist: make it with `make all`, or name other captures")
    trials = [Trial(capture, preset, 0, options.out) for capture in captures for preset in options.presets]
    step: Callable[[Trial], RunState] = (
        read_trial if options.write_only else lambda trial: run_and_compare(trial, trials)
    )
    runs = {trial: step(trial) for trial in track(trials, "runs")}
    failed = [trial.run_dir.name for trial, run in runs.items() if run.status != "done"]
    if failed:
        raise UserError(
            f"{', '.join(failed)} not finished: see {options.out}/NAME.log, then run the same command again"
        )
    origin = single_origin(runs)
    reports = {trial: json.loads((trial.run_dir / "report" / "report.json").read_text("utf-8")) for trial in trials}
    command = f"make figures CAPTURES='{' '.join(map(str, captures))}' PRESETS='{' '.join(options.presets)}'"
    note = f"\n{origin}; `{command}`."
    tables = {"presets": preset_table(runs, reports) + note, "stages": stage_table(runs, reports) + note}
    for document in DOCUMENTS:
        if document.is_file():
            text = document.read_text(encoding="utf-8")
            document.write_text(insert_tables(text, tables, document, (MATERIALS,)), encoding="utf-8")
    print(f"tables written to {', '.join(str(path) for path in DOCUMENTS if path.is_file())}: {origin}")


def single_origin(runs: Mapping[Trial, RunState]) -> str:
    """Commit and machine of all runs, as one sentence part; UserError where they differ."""
    rows = [table_row(trial, run) for trial, run in runs.items()]
    commits, machines = ({str(row[name]) for row in rows} for name in ("commit", "machine"))
    if len(commits) > 1 or ";" in "".join(commits):
        raise UserError(f"the runs are of several commits ({', '.join(sorted(commits))}): remove the older runs")
    commit, machine = commits.pop(), "; ".join(sorted(machines))
    return f"Commit {short_commit(commit)}, {machine}"


def preset_table(runs: Mapping[Trial, RunState], reports: Mapping[Trial, Mapping[str, Any]]) -> str:
    """One row a capture and preset: seconds to the avatar, PSNR of the mesh, Chamfer distance, faces, memory."""
    head = "| capture | preset | seconds | held-out PSNR, image / body, dB | Chamfer, mm | faces | peak MiB |"
    lines = [head, "|---|---|---|---|---|---|---|"]
    for trial, run in runs.items():
        scores, report = run.scores, reports[trial]
        chamfer = scores.get("chamfer_mm")
        cells = [
            trial.capture_name,
            f"`{trial.label}`",
            f"{run.seconds(STAGES_UNTIL_EXPORT):.0f}",
            f"{scores['mesh_psnr_full_db']:.1f} / {scores['mesh_psnr_body_db']:.1f}",
            "" if chamfer is None else f"{chamfer:.1f}",
            f"{report['mesh']['faces']:,}",
            f"{report['peak_rss_mib']['total']:.0f}",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def stage_table(runs: Mapping[Trial, RunState], reports: Mapping[Trial, Mapping[str, Any]]) -> str:
    """One row a capture and preset: seconds of each stage."""
    lines = [f"| capture | preset | {' | '.join(stages.STAGES)} | total |", "|---" * (len(stages.STAGES) + 3) + "|"]
    for trial in runs:
        seconds = reports[trial]["seconds"]
        cells = [f"{seconds[name]:.0f}" for name in (*stages.STAGES, "total")]
        lines.append(f"| {trial.capture_name} | `{trial.label}` | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def insert_tables(text: str, tables: Mapping[str, str], document: Path, others: Sequence[str] = ()) -> str:
    """The document with every marked table replaced.

    others: names of tables that stay as they are, because another command writes them.

    Raises:
        UserError: a marker names an unknown table or has no end.
    """

    def replaced(found: re.Match[str]) -> str:
        name = found.group(1)
        if name in others:
            return found.group(0)
        if name not in tables:
            raise UserError(f"{document}: no table is called {name}, only {', '.join(tables)}")
        return f"<!-- figures: {name} -->\n\n{tables[name]}\n{END}"

    if text.count("<!-- figures:") != text.count(END):
        raise UserError(f"{document}: a `<!-- figures: NAME -->` has no `{END}`")
    return re.sub(r"<!-- figures: (\S+) -->.*?" + re.escape(END), replaced, text, flags=re.DOTALL)


def read_table(text: str, name: str) -> str:
    """Return what stands between the markers of a table of a document; empty without them."""
    found = re.search(rf"<!-- figures: {re.escape(name)} -->(.*?){re.escape(END)}", text, flags=re.DOTALL)
    return found.group(1) if found else ""


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m data_tools.sweep.figures", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("captures", nargs="*", type=Path, help="synthetic captures or videos (default: the sample)")
    parser.add_argument("--presets", nargs="+", default=list(PRESETS), help=f"presets (default: {' '.join(PRESETS)})")
    parser.add_argument("--out", type=Path, default=Path("runs/figures"), help="folder of the runs")
    parser.add_argument("--write-only", action="store_true", help="write the tables of finished runs, run nothing")
    return parser.parse_args(argv)


if __name__ == "__main__":
    raise SystemExit(run_command(main, sys.argv[1:]))
