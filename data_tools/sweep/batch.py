"""Run the pipeline on all videos of a folder, and write a table with states, seconds and scores.

python -m data_tools.sweep.batch VIDEOS [--runs runs --preset fine --set mesh.edge_px=2 --jobs 2]

A failed video does not stop the others. Each video has a run folder in `runs`, so the same command continues after an
interruption. The table is written to `batch.csv` and `batch.html` in `runs`.
"""

import argparse
import sys
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

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
from data_tools.templates import render_template
from pipeline.capture.video import VIDEO_SUFFIXES
from pipeline.core.atomic import atomic_path
from pipeline.core.config import parse_overrides
from pipeline.core.errors import UserError
from pipeline.core.manifest import list_files
from pipeline.core.progress import track
from pipeline.core.run_folder import RunRequest, default_run_dir
from pipeline.core.status import FRESH


def main(argv: Sequence[str]) -> None:
    """Run all videos, or only write the table.

    Raises:
        UserError: the folder has no video, two videos share a name, or some videos have no avatar.
    """
    options = _parse(argv)
    videos = find_videos(options.videos)
    if not options.table:
        _run_videos(videos, options)
    rows = {name: table_row(name, _read_run(name, videos, options)) for name in track(videos, "table")}
    write_table(options.runs, rows.values())
    print(text_table(rows.values()))
    failed = [name for name, row in rows.items() if row["status"] != "done"]
    if failed:
        raise UserError(
            f"{len(failed)} of {len(rows)} videos have no avatar ({', '.join(failed)}): "
            f"see {options.runs / 'batch.html'}; run the same command to try again"
        )


def find_videos(folder: Path) -> dict[str, Path]:
    """Find videos by the name of their run, sorted: video files, and folders of images or captures.

    Hidden files and folders are ignored.

    Raises:
        UserError: there is no video, or two videos would share a run.
    """
    if not folder.is_dir():
        raise UserError(f"{folder} is not a folder: name a folder of videos or of image folders, VIDEOS=folder")
    videos: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.name.startswith(".") or not (path.is_dir() or path.suffix.lower() in VIDEO_SUFFIXES):
            continue
        name = default_run_dir(path).name
        if name in videos:
            raise UserError(f"{videos[name].name} and {path.name} in {folder} would share the run {name}: rename one")
        videos[name] = find_video(path)
    if not videos:
        raise UserError(f"{folder} contains no video and no folder of images: add some")
    return videos


def newest_mtime_ns(video: Path) -> int:
    """Return the modification time of a video, in ns since the epoch; of a folder, that of its newest file."""
    files = [video] if video.is_file() else [video / name for name in list_files(video)]
    return max((path.stat().st_mtime_ns for path in files), default=0)


def table_row(name: str, run: RunState) -> dict[str, str]:
    """Return one row of the table: all columns as text, empty if there is no value."""
    row = {"video": name, "status": run.status, **run.states}
    for stage in run.states:
        row[f"{stage}_seconds"] = f"{run.seconds([stage]):.1f}" if stage in run.manifests else ""
    row["seconds"] = f"{run.seconds(list(run.states)):.1f}"
    for column in SCORE_PATHS:
        row[column] = f"{run.scores[column]:.3f}" if column in run.scores else ""
    return row | {"message": "" if run.status == "done" else run.failure}


def text_table(rows: Iterable[Mapping[str, str]]) -> str:
    """Format the table for a terminal, followed by the error messages."""
    rows = list(rows)
    cells = [_heading(), *map(_cells, rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = ["  ".join(map(str.rjust, line, widths)) for line in cells]
    return "\n".join(lines + [f"{row['video']}: {row['message']}" for row in rows if row["message"]])


def write_table(runs: Path, rows: Iterable[Mapping[str, str]]) -> None:
    """Write `batch.csv` and `batch.html` to the folder of the runs."""
    rows = list(rows)
    runs.mkdir(parents=True, exist_ok=True)
    write_csv(runs / "batch.csv", list(rows[0]), [list(row.values()) for row in rows])
    done = sum(row["status"] == "done" for row in rows)
    page = render_template(
        "data_tools.sweep",
        "batch.html.j2",
        summary=f"{done} of {len(rows)} avatars",
        heading=[*_heading(), "message"],
        rows=[(row["status"], row["video"], _cells(row)[1:], row["message"]) for row in rows],
    )
    with atomic_path(runs / "batch.html") as path:
        path.write_text(page, encoding="utf-8")


def _run_videos(videos: Mapping[str, Path], options: argparse.Namespace) -> None:
    """Run `--jobs` videos at a time, each in its own process."""
    validate_run_options(options.preset or "default", options.set)
    arguments = ["--preset", options.preset] if options.preset else []
    arguments += [argument for assignment in options.set for argument in ("--set", assignment)]
    threads = max(1, cpu_cores() // options.jobs) if options.jobs > 1 else None

    def run_one_video(name: str) -> str:
        run_dir = options.runs / name
        tqdm.write(f"{name}: started, log in {log_path(run_dir)}", file=sys.stderr)
        start_run(run_dir, ["--video", str(videos[name]), *arguments], threads)
        return f"{name}: {_read_run(name, videos, options).status}"

    with ThreadPoolExecutor(options.jobs) as pool:
        futures = [pool.submit(run_one_video, name) for name in videos]
        try:
            for future in track(as_completed(futures), "videos", total=len(futures)):
                tqdm.write(future.result(), file=sys.stderr)
        finally:
            pool.shutdown(cancel_futures=True)


def _read_run(name: str, videos: Mapping[str, Path], options: argparse.Namespace) -> RunState:
    """Read the run of a video; only results of this video with the options of the command count."""
    run_dir, overrides = options.runs / name, parse_overrides(options.set)
    return read_run(run_dir, request=RunRequest(run_dir, videos[name], options.preset, overrides))


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m data_tools.sweep.batch", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("videos", type=Path, help="folder of videos, or of image folders")
    parser.add_argument("--runs", type=Path, default=Path("runs"), help="parent of the run folders")
    parser.add_argument("--preset", help="a name in configs/ or a .yaml file, for all videos")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="option for all videos")
    parser.add_argument("--jobs", type=int, default=1, help="number of parallel runs; each may need 2 GiB of memory")
    parser.add_argument("--table", action="store_true", help="only write the table, run nothing")
    options = parser.parse_args(argv)
    if options.jobs < 1:
        raise UserError(f"--jobs {options.jobs} is too small: choose at least 1")
    return options


def _heading() -> list[str]:
    return ["video", "status", *stages.STAGES, "seconds", *(name.removesuffix("_db") for name in SCORE_PATHS)]


def _cells(row: Mapping[str, str]) -> list[str]:
    spent = [row[f"{stage}_seconds"] if row[stage] == FRESH else row[stage].split()[0] for stage in stages.STAGES]
    return [row["video"], row["status"], *spent, row["seconds"], *(row[score] for score in SCORE_PATHS)]


if __name__ == "__main__":
    raise SystemExit(run_command(main, sys.argv[1:]))
