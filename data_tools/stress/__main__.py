"""Run the stress test: sweeps of known failures, each with a pass line.

python -m data_tools.stress [--rows focal broken-numbers ...] [--out runs/stress] [--write-only]

Results of trials are kept in OUT/results, so an interrupted sweep continues, and a trial runs again only when its
settings, the preset or the version of a stage change. Writes OUT/stress.csv, stress.png and the tables of
docs/stress.md, which show the newest result of each trial and name its commit; a row of which they show more trials
than have results in OUT stays as it is. Exit status 1: a pass line is crossed; 2: an input is not valid.
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from tqdm import tqdm

from data_tools.command import run_command
from data_tools.stress.row import Results, Row
from data_tools.stress.rows import ROWS
from data_tools.stress.run_trial import read_latest, run_trial
from data_tools.stress.store import index_results
from data_tools.stress.tables import Sweep, draw_figure, write_csv_table, write_document
from data_tools.sweep.chart_figure import save_figure
from pipeline.core.measure import REPOSITORY_DIR
from pipeline.core.progress import track

EXIT_CROSSED = 1
DOCUMENT = REPOSITORY_DIR / "docs" / "stress.md"


class _Crossed(Exception):
    """A pass line was crossed; the message names the rows."""


def main(argv: Sequence[str]) -> int:
    """Run the command and return its exit status."""
    try:
        return run_command(_run, argv)
    except _Crossed as crossed:
        print(f"crossed: {crossed}", file=sys.stderr)
        return EXIT_CROSSED


def _run(argv: Sequence[str]) -> None:
    options = _parse(argv)
    options.out.mkdir(parents=True, exist_ok=True)
    chosen = {name: ROWS[name] for name in options.rows}
    if not options.write_only:
        pairs = [(row, trial) for row in chosen.values() for trial in row.trials]
        for row, trial in track(pairs, "trials"):
            result = run_trial(options.out, trial, options.keep)
            tqdm.write(f"{row.name}, {trial.label}: {result.state} {result.message}".rstrip(), file=sys.stderr)
    crossed = write_results(options.out, options.document, ROWS, list(chosen))
    if crossed:
        raise _Crossed("; ".join(crossed))


def write_results(out: Path, document: Path | None, rows: dict[str, Row], chosen: Sequence[str]) -> list[str]:
    """Write tables and figure of all rows with results; return a sentence for each chosen row that is crossed."""
    older = index_results(out / "results")
    sweep: Sweep = {name: read_results(out, row, older) for name, row in rows.items()}
    write_csv_table(out / "stress.csv", rows, sweep)
    if any(result.scores for results in sweep.values() for result in results.values()):
        save_figure(draw_figure(rows, sweep), out, "stress", dpi=110)
    if document is not None:
        write_document(document, rows, sweep, "make stress")
    crossed = []
    for name in chosen:
        verdict, sentences = rows[name].verdict(sweep[name])
        print(f"{name}: {verdict}")
        if verdict == "crossed":
            crossed.append(f"{name} ({sentences[0]}{', ...' if len(sentences) > 1 else ''})")
    return crossed


def read_results(out: Path, row: Row, older: Mapping[str, Path]) -> Results:
    """Return the newest results of a row by the label of the trial; `MISSING` where a trial has never run."""
    return {trial.label: read_latest(out, trial, older) for trial in row.trials}


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m data_tools.stress", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rows", nargs="+", choices=list(ROWS), default=list(ROWS), help="rows; default: all")
    parser.add_argument("--out", type=Path, default=Path("runs/stress"), help="folder of results, captures and runs")
    parser.add_argument("--document", type=Path, default=DOCUMENT, help="document with the tables")
    parser.add_argument("--write-only", action="store_true", help="write the tables of what is finished, run nothing")
    parser.add_argument("--keep", action="store_true", help="keep the run folders of the trials")
    return parser.parse_args(argv)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
