"""Ablation of stage two: remove, replace or add one part of it, on equal fields.

python -m data_tools.sweep.ablate [CAPTURE ...] [--rows uniform error-driven --seeds 0 1 2 --out runs/ablate]

Frames, body and field are made once for each capture and seed; each row runs the stages from the mesh on, with links to
them, so the same command continues an interrupted sweep. A seed is that of the field and of the mesh stage. Outputs in
OUT: `ablation.csv` (one line per run), `ablation.md` (tables for the documents) and `ablation.html` (with clay).
"""

import argparse
import sys
from collections.abc import Sequence
from itertools import product
from pathlib import Path

from tqdm import tqdm

from data_tools.command import run_command
from data_tools.sweep.ablation_rows import REFERENCE, ROWS
from data_tools.sweep.ablation_tables import write_tables
from data_tools.sweep.ablation_trials import AblationResult, AblationTrial, read_row, run_row
from data_tools.sweep.chart_trials import Trial, require_distinct_run_folders
from data_tools.sweep.figures import CAPTURES
from data_tools.sweep.runs import validate_run_options
from pipeline.core.errors import UserError
from pipeline.core.progress import track


def main(argv: Sequence[str]) -> None:
    """Run what is missing, then write the tables.

    Raises:
        UserError: a capture or preset does not exist, two captures would share a run, or some runs are not finished
            (the others are in the tables).
    """
    options = _parse(argv)
    captures = options.captures or list(CAPTURES)
    missing = [str(path) for path in captures if not path.exists()]
    if missing:
        raise UserError(f"{missing[0]} does not exist: name synthetic captures, videos or folders of images")
    validate_run_options(options.preset, [])
    bases = [Trial(path, options.preset, seed, options.out) for seed, path in product(options.seeds, captures)]
    require_distinct_run_folders(bases)
    # The numbers of faces of some rows are those of the reference.
    ordered = sorted(options.rows, key=lambda name: name != REFERENCE)
    results: dict[AblationTrial, AblationResult] = {}
    for base, name in track(list(product(bases, ordered)), "runs"):
        trial = AblationTrial(base, ROWS[name])
        results[trial] = read_row(trial) if options.write_only else run_row(trial, bases)
        tqdm.write(f"{trial.run_dir.name}: {results[trial].status} {results[trial].failure}".rstrip(), file=sys.stderr)
        write_tables(options.out, results, _command(captures, options))
    unfinished = [trial.run_dir.name for trial, result in results.items() if result.status != "done"]
    if unfinished:
        raise UserError(
            f"{len(unfinished)} of {len(results)} runs are not done ({', '.join(unfinished)}): see "
            f"{options.out}/ablation.csv; run the same command to try again"
        )
    print(f"{len(results)} runs: {options.out}/ablation.csv, ablation.md, ablation.html")


def _command(captures: Sequence[Path], options: argparse.Namespace) -> str:
    """Return the command that makes the same tables."""
    values = {"CAPTURES": captures, "ROWS": options.rows, "SEEDS": options.seeds}
    if options.rows == list(ROWS):
        del values["ROWS"]
    if options.preset != "default":
        values["ARGS"] = ["--preset", options.preset]
    return " ".join(["make ablate", *(f"{name}='{' '.join(map(str, items))}'" for name, items in values.items())])


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m data_tools.sweep.ablate", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument(
        "captures", nargs="*", type=Path, help="captures, videos or image folders; default: the generated sample"
    )
    parser.add_argument("--rows", nargs="+", choices=list(ROWS), default=list(ROWS), help="rows; default: all")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2], help="seeds; default: 0 1 2")
    parser.add_argument("--preset", default="default", help="preset of all runs")
    parser.add_argument("--out", type=Path, default=Path("runs/ablate"), help="folder of the runs and the tables")
    parser.add_argument("--write-only", action="store_true", help="write the tables of finished runs, run nothing")
    return parser.parse_args(argv)


if __name__ == "__main__":
    raise SystemExit(run_command(main, sys.argv[1:]))
