"""Every video of a folder becomes an avatar, and a table tells how: states, seconds and scores.

python -m data_tools.sweep.batch VIDEOS [--runs runs --preset fine --set mesh.edge_px=2 --jobs 2]

A video that cannot be used never stops the rest. Each is a run folder below `runs`, so the same command goes on after
an interruption. The table is written as `batch.csv` and `batch.html` into `runs`.
"""

import argparse
import sys
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from html import escape
from pathlib import Path
from string import Template

from tqdm import tqdm

import stages
from data_tools.command import run_command
from data_tools.sweep.runs import (
    SCORE_PATHS,
    RunState,
    cpu_cores,
    find_video,
    log_path,
    read_run,
    start_run,
    validate_run_options,
    write_csv,
)
from pipeline.capture.video import VIDEO_SUFFIXES
from pipeline.core.atomic import atomic_path
from pipeline.core.errors import UserError
from pipeline.core.progress import track
from pipeline.core.run_folder import default_run_dir
from pipeline.core.status import FRESH

PAGE = Template(
    """<!doctype html><html lang="en"><meta charset="utf-8"><title>Batch</title><style>
body { font: 14px system-ui, sans-serif; margin: 2rem; color-scheme: light dark; }
table { border-collapse: collapse; } th, td { padding: .3rem .6rem; text-align: right; border-bottom: 1px solid #8884; }
td:first-child, td:last-child { text-align: left; } .failed td { color: #c33; } .unfinished td { color: #a60; }
</style><h1>$summary</h1><p>Stages: seconds where fresh, else the state. PSNR on held-out frames, dB.</p>
<table><tr>$heading</tr>
$rows
</table></html>
"""
)


def main(argv: Sequence[str]) -> None:
    """Run all videos, or tell how far they are.

    Raises:
        UserError: no video is there, two share a name, or some did not become an avatar.
    """
    options = _parse(argv)
    videos = find_videos(options.videos)
    if not options.table:
        _run_videos(videos, options)
    rows = {name: table_row(name, read_run(options.runs / name)) for name in track(videos, "table")}
    write_table(options.runs, rows.values())
    print(text_table(rows.values()))
    failed = [name for name, row in rows.items() if row["status"] != "done"]
    if failed:
        raise UserError(
            f"{len(failed)} of {len(rows)} videos did not become an avatar ({', '.join(failed)}): "
            f"see {options.runs / 'batch.html'}; the same command tries them again"
        )


def find_videos(folder: Path) -> dict[str, Path]:
    """Videos by the name of their run, sorted: files with a video's suffix, and folders of images or captures.

    What is hidden is left out.

    Raises:
        UserError: there is none, or two would have one run.
    """
    if not folder.is_dir():
        raise UserError(f"{folder} is no folder: give one that holds videos or folders of images with VIDEOS=")
    videos: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.name.startswith(".") or not (path.is_dir() or path.suffix.lower() in VIDEO_SUFFIXES):
            continue
        name = default_run_dir(path).name
        if name in videos:
            raise UserError(f"{videos[name].name} and {path.name} in {folder} would share the run {name}: rename one")
        videos[name] = find_video(path)
    if not videos:
        raise UserError(f"{folder} holds no video and no folder of images: put some into it")
    return videos


def newest_mtime_ns(video: Path) -> int:
    """When a video's content changed last, in nanoseconds since 1970; of a folder, its newest file."""
    files = [video] if video.is_file() else [path for path in video.rglob("*") if path.is_file()]
    return max((path.stat().st_mtime_ns for path in files), default=0)


def table_row(name: str, run: RunState) -> dict[str, str]:
    """One line of the table: every column as text, empty where there is nothing to tell."""
    row = {"video": name, "status": run.status, **run.states}
    for stage in run.states:
        row[f"{stage}_seconds"] = f"{run.seconds([stage]):.1f}" if stage in run.manifests else ""
    row["seconds"] = f"{run.seconds(list(run.states)):.1f}"
    for column in SCORE_PATHS:
        row[column] = f"{run.scores[column]:.3f}" if column in run.scores else ""
    return row | {"message": "" if run.status == "done" else run.failure}


def text_table(rows: Iterable[Mapping[str, str]]) -> str:
    """The table for a terminal, what went wrong in lines beneath it."""
    rows = list(rows)
    cells = [_heading(), *map(_cells, rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = ["  ".join(map(str.rjust, line, widths)) for line in cells]
    return "\n".join(lines + [f"{row['video']}: {row['message']}" for row in rows if row["message"]])


def write_table(runs: Path, rows: Iterable[Mapping[str, str]]) -> None:
    """`batch.csv` and `batch.html` in the folder of the runs."""
    rows = list(rows)
    runs.mkdir(parents=True, exist_ok=True)
    write_csv(runs / "batch.csv", list(rows[0]), [list(row.values()) for row in rows])
    done = sum(row["status"] == "done" for row in rows)
    heading = "".join(f"<th>{escape(cell)}</th>" for cell in [*_heading(), "message"])
    page = PAGE.substitute(
        summary=f"{done} of {len(rows)} avatars", heading=heading, rows="\n".join(map(_html_row, rows))
    )
    with atomic_path(runs / "batch.html") as path:
        path.write_text(page, encoding="utf-8")


def _run_videos(videos: Mapping[str, Path], options: argparse.Namespace) -> None:
    """`--jobs` at a time, each in a process of its own."""
    validate_run_options(options.preset or "default", options.set)
    arguments = ["--preset", options.preset] if options.preset else []
    arguments += [word for assignment in options.set for word in ("--set", assignment)]
    threads = max(1, cpu_cores() // options.jobs) if options.jobs > 1 else None

    def run_one_video(name: str) -> str:
        run_dir = options.runs / name
        tqdm.write(f"{name}: started, says what it does in {log_path(run_dir)}", file=sys.stderr)
        start_run(run_dir, ["--video", str(videos[name]), *arguments], threads)
        return f"{name}: {read_run(run_dir).status}"

    with ThreadPoolExecutor(options.jobs) as pool:
        futures = [pool.submit(run_one_video, name) for name in videos]
        try:
            for future in track(as_completed(futures), "videos", total=len(futures)):
                tqdm.write(future.result(), file=sys.stderr)
        finally:
            pool.shutdown(cancel_futures=True)


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m data_tools.sweep.batch", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("videos", type=Path, help="folder with videos, or with folders of images")
    parser.add_argument("--runs", type=Path, default=Path("runs"), help="where the run folders are made")
    parser.add_argument("--preset", help="a name in configs/ or a .yaml file, for all videos")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="an option for all")
    parser.add_argument("--jobs", type=int, default=1, help="videos at the same time; each may need 2 GiB of memory")
    parser.add_argument("--table", action="store_true", help="run nothing, only tell how far all are")
    options = parser.parse_args(argv)
    if options.jobs < 1:
        raise UserError(f"--jobs {options.jobs} is too few: give at least 1")
    return options


def _heading() -> list[str]:
    return ["video", "status", *stages.STAGES, "seconds", *(name.removesuffix("_db") for name in SCORE_PATHS)]


def _cells(row: Mapping[str, str]) -> list[str]:
    spent = [row[f"{stage}_seconds"] if row[stage] == FRESH else row[stage].split()[0] for stage in stages.STAGES]
    return [row["video"], row["status"], *spent, row["seconds"], *(row[score] for score in SCORE_PATHS)]


def _html_row(row: Mapping[str, str]) -> str:
    name, *cells = map(escape, _cells(row))
    link = f'<a href="{name}/report/index.html">{name}</a>' if row["status"] == "done" else name
    log = f'{escape(row["message"])} <a href="{name}.log">log</a>' if row["message"] else ""
    return f'<tr class="{row["status"]}">' + "".join(f"<td>{cell}</td>" for cell in [link, *cells, log]) + "</tr>"


if __name__ == "__main__":
    raise SystemExit(run_command(main, sys.argv[1:]))
