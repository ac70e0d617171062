"""The commands: `python -m stages` runs all, `python -m stages.<name>` runs one. Errors are one sentence, exit 2."""

import argparse
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NoReturn

from pipeline.core.config import CONFIG_DIR, build_config, default_yaml, load_layers
from pipeline.core.errors import UserError, format_os_error
from pipeline.core.lock import die_with_parent, is_runner_child, run_lock
from pipeline.core.record import RUN_FILE, RunRecord, read_record, update_record, write_record
from pipeline.core.runner import EXIT_INTERRUPTED, StageFailedError, build_configs, run_all, status, summary, verify
from pipeline.core.stage import Stage, plan_stage, run_stage

EXIT_USER_ERROR = 2

LoadStage = Callable[[str], Stage]


def main(stage: Stage, argv: Sequence[str] | None = None, config_dir: Path = CONFIG_DIR) -> int:
    """Run one stage on one run folder; return the exit status."""
    die_with_parent()
    return _run_with_exit_status(lambda: _run_single_stage(stage, argv, config_dir))


def main_all(
    names: Sequence[str], load: LoadStage, argv: Sequence[str] | None = None, config_dir: Path = CONFIG_DIR
) -> int:
    """Run, or report on, all stages of one run folder; return the exit status."""
    die_with_parent()
    return _run_with_exit_status(lambda: _run_pipeline(names, load, argv, config_dir))


def _run_single_stage(stage: Stage, argv: Sequence[str] | None, config_dir: Path) -> None:
    parser = _Parser(prog=f"python -m stages.{stage.name}", description=f"Run the stage {stage.name} alone.")
    parser.add_argument("run", type=Path, help="the run folder, runs/NAME")
    _add_record_options(parser)
    parser.add_argument("--force", action="store_true", help="run even when the result is there already")
    options = parser.parse_args(argv)
    for assignment in options.set:
        if not assignment.startswith(f"{stage.name}."):
            raise UserError(f"--set {assignment} is not for this stage: write --set {stage.name}.key=value")
    with _open_run(options.run, options, replace_video=options.force) as (record, _):
        config = build_config(stage.name, stage.config, load_layers(record.preset, record.overrides, config_dir))
        plan = plan_stage(stage, config, options.run, record.video_path)
        write_record(record, options.run)
        ran = run_stage(plan, options.force)
    if not is_runner_child():
        print(f"{plan.folder}: {'done' if ran else 'cached'}")


def _run_pipeline(names: Sequence[str], load: LoadStage, argv: Sequence[str] | None, config_dir: Path) -> None:
    options = _parse_pipeline_arguments(names, argv)
    stages = [load(name) for name in names]
    if options.defaults:
        print(default_yaml({stage.name: stage.config for stage in stages}), end="")
        return
    run_dir: Path = options.run or default_run_dir(options.video)
    if options.status or options.verify:
        record = read_record(run_dir)
        report = verify(stages, run_dir) if options.verify else ""
        print(report or status(stages, build_configs(stages, record, config_dir), run_dir, record))
        return
    forced = names if options.force else names[names.index(options.from_stage) :] if options.from_stage else ()
    start = time.monotonic()
    with _open_run(run_dir, options, replace_video=names[0] in forced) as (record, lock_fd):
        configs = build_configs(stages, record, config_dir)
        write_record(record, run_dir)
        outcomes = run_all(stages, configs, run_dir, record, lock_fd, lambda name: name in forced)
    print(summary(outcomes, time.monotonic() - start))


def _parse_pipeline_arguments(names: Sequence[str], argv: Sequence[str] | None) -> argparse.Namespace:
    parser = _Parser(prog="python -m stages", description=f"Run the whole pipeline: {', '.join(names)}.")
    parser.add_argument("--run", type=Path, help="the run folder (default: runs/NAME after the video)")
    _add_record_options(parser)
    parser.add_argument("--from", dest="from_stage", choices=names, metavar="STAGE", help="run STAGE and what follows")
    parser.add_argument("--force", action="store_true", help="run every stage anew")
    parser.add_argument("--verify", action="store_true", help="digest every artifact again and name what is damaged")
    parser.add_argument("--status", action="store_true", help="show what is fresh, stale, unfinished or missing")
    parser.add_argument("--defaults", action="store_true", help="print every option with its default, as YAML")
    return parser.parse_args(argv)


def _add_record_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--video", type=Path, help="video file or image folder; remembered in the run folder")
    parser.add_argument("--preset", help="a name in configs/ or a .yaml file; remembered, drops earlier --set")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="an option; remembered")


def default_run_dir(video: Path | None) -> Path:
    """runs/NAME after the video's name; after its folder's where the file is just called `video`."""
    if video is None:
        raise UserError("no run given: python -m stages --run runs/NAME [--video FILE_OR_FOLDER]")
    video = video.resolve()
    name = video.stem if video.is_file() else video.name
    return Path("runs") / (video.parent.name if name == "video" else name)


class _Parser(argparse.ArgumentParser):
    """Argument errors in the same form as all others."""

    def __init__(self, prog: str, description: str) -> None:
        super().__init__(prog=prog, description=description, allow_abbrev=False)

    def error(self, message: str) -> NoReturn:
        raise UserError(f"{message}: see {self.prog} --help")


@contextmanager
def _open_run(run_dir: Path, options: argparse.Namespace, replace_video: bool) -> Iterator[tuple[RunRecord, int]]:
    """Lock the run folder; yield its record, updated by the options, and the lock's descriptor.

    A command that fails before any stage is finished takes the folder it made away again.
    """
    if run_dir.is_file():
        raise UserError(f"{run_dir} is a file, a run is a folder: choose another name with --run")
    is_new = not run_dir.exists()
    record = update_record(read_record(run_dir), run_dir, options.video, options.preset, options.set, replace_video)
    run_dir.mkdir(parents=True, exist_ok=True)
    with run_lock(run_dir) as lock_fd:
        try:
            yield record, lock_fd
        except (UserError, StageFailedError, OSError, MemoryError):
            if is_new and {path.name for path in run_dir.iterdir()} <= {RUN_FILE, ".lock"}:
                for path in list(run_dir.iterdir()):
                    path.unlink()
                run_dir.rmdir()
            raise


def _run_with_exit_status(work: Callable[[], None]) -> int:
    """Run `work`; turn what the user can mend into one sentence and an exit status. Faults of the program stay loud."""
    try:
        work()
    except UserError as error:
        return _report_error(str(error))
    except StageFailedError as failure:
        return failure.code
    except MemoryError:
        return _report_error("there is not enough memory: close other programs, or use --preset instant")
    except OSError as error:
        sentence = format_os_error(error)
        if sentence is None:
            raise
        return _report_error(sentence)
    except KeyboardInterrupt:
        if not is_runner_child():
            print("interrupted: the same command goes on from here", file=sys.stderr)
        return EXIT_INTERRUPTED
    return 0


def _report_error(sentence: str) -> int:
    print(f"error: {sentence}", file=sys.stderr)
    return EXIT_USER_ERROR
