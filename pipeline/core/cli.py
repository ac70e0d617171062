"""Command line: run all stages of a video, or one stage of a run. User errors are one sentence and exit status 2."""

import argparse
import difflib
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NoReturn

from pipeline.core.command import format_command, program_name
from pipeline.core.config import CONFIG_DIR, build_config, default_yaml, load_layers, parse_overrides
from pipeline.core.errors import EXIT_USER_ERROR, UserError, format_os_error
from pipeline.core.events import send_event, send_progress
from pipeline.core.manifest import require_matching_stages
from pipeline.core.parent import die_with_parent, is_runner_child
from pipeline.core.pipeline import Pipeline
from pipeline.core.preparation import prepare_machine
from pipeline.core.record import read_record
from pipeline.core.run_folder import RunRequest, StageFailedError, default_run_dir, open_run, require_run
from pipeline.core.runner import EXIT_INTERRUPTED, HOW_TO_RESUME, RunOptions, format_summary, run_pipeline
from pipeline.core.stage import Stage, plan_stage, run_stage
from pipeline.core.status import format_status, verify_artifacts


def main(stage: Stage, argv: Sequence[str] | None = None, config_dir: Path = CONFIG_DIR) -> int:
    """Run the command of one stage, `python -m stages.NAME RUN`; return the exit status."""
    die_with_parent()
    arguments = sys.argv[1:] if argv is None else argv
    return _run_with_exit_status(lambda: _run_single_stage(stage, arguments, config_dir), arguments)


def main_pipeline(
    pipeline: Pipeline, argv: Sequence[str] | None = None, version: str = "", isolate: bool = True
) -> int:
    """Run the command of a pipeline, `COMMAND VIDEO` or `COMMAND STAGE RUN`; return the exit status.

    Args:
        argv: arguments of the command; default those of this process.
        version: text that `--version` prints.
        isolate: whether each stage runs in a process of its own.
    """
    die_with_parent()
    arguments = list(sys.argv[1:] if argv is None else argv)
    if arguments and arguments[0] in pipeline.names:
        stage_name = arguments[0]
        return _run_with_exit_status(
            lambda: _run_single_stage(pipeline.load_stage(stage_name), arguments[1:], pipeline.config_dir), arguments
        )
    return _run_with_exit_status(lambda: _run_pipeline(pipeline, arguments, version, isolate), arguments)


def _run_single_stage(stage: Stage, argv: Sequence[str], config_dir: Path) -> None:
    parser = _Parser(prog=format_command(stage.name), description=f"Run the stage {stage.name}.")
    parser.add_argument("run", type=_path, help="run folder, runs/NAME")
    _add_record_options(parser)
    parser.add_argument("--force", action="store_true", help="run even if the result is fresh")
    options = parser.parse_args(argv)
    for assignment in options.set:
        if not assignment.startswith(f"{stage.name}."):
            raise UserError(f"--set {assignment} is not an option of this stage: write --set {stage.name}.key=value")
    request = _build_request(options.run, options, replace_video=options.force)
    with open_run(request) as run, send_progress():
        layers = load_layers(run.record.preset, run.record.overrides, config_dir)
        config = build_config(stage.name, stage.config, layers)
        plan = plan_stage(stage, config, options.run, run.record.video_path)
        require_matching_stages(options.run, stage.needs)
        with run.recorded_for(stage):
            has_run = run_stage(plan, options.force)
    if not is_runner_child():
        print(f"{plan.folder}: {'done' if has_run else 'cached'}")


def _run_pipeline(pipeline: Pipeline, argv: Sequence[str], version: str, isolate: bool) -> None:
    options = _parse_pipeline_arguments(pipeline.names, argv)
    if options.version:
        print(version)
        return
    if options.prepare:
        prepare_machine(pipeline.preparations)
        return
    if options.defaults:
        print(default_yaml({stage.name: stage.config for stage in pipeline.load_stages()}), end="")
        return
    run_dir: Path = options.run or default_run_dir(options.video)
    if options.verify:
        require_run(run_dir)
        print(verify_artifacts(pipeline, run_dir))
        return
    forced = _forced_stages(pipeline.names, options)
    request = _build_request(run_dir, options, replace_video=pipeline.names[0] in forced)
    if options.status:
        require_run(run_dir)
        print(format_status(pipeline, run_dir, request.apply(read_record(run_dir))))
        return
    start = time.monotonic()
    run_options = RunOptions(forced, isolate, fork_command=lambda arguments: main_pipeline(pipeline, arguments))
    outcomes = run_pipeline(pipeline, request, run_options)
    print(format_summary(outcomes, time.monotonic() - start))


def _forced_stages(names: tuple[str, ...], options: argparse.Namespace) -> tuple[str, ...]:
    if options.force:
        return names
    return names[names.index(options.from_stage) :] if options.from_stage else ()


def _parse_pipeline_arguments(names: Sequence[str], argv: Sequence[str]) -> argparse.Namespace:
    command = program_name()
    parser = _Parser(
        prog=command,
        description="Make a textured, rigged avatar from a video of one person.",
        epilog=f"{command} STAGE RUN runs one stage of a run folder; STAGE is one of {', '.join(names)}. "
        f"{command} STAGE --help lists its arguments.",
    )
    parser.add_argument("input", nargs="?", type=_path, metavar="VIDEO", help="video file or image folder")
    parser.add_argument("--run", type=_path, help="run folder (default: runs/NAME, with the name of the video)")
    _add_record_options(parser)
    parser.add_argument("--from", dest="from_stage", choices=names, metavar="STAGE", help="run STAGE and all after it")
    parser.add_argument("--force", action="store_true", help="run every stage, even if its result is fresh")
    mode = parser.add_mutually_exclusive_group()
    mode.add_argument("--verify", action="store_true", help="digest every artifact again and name damaged ones")
    mode.add_argument(
        "--status",
        action="store_true",
        help="show which stages are fresh, stale, unfinished, missing; with --set, --preset or a video: what these "
        "would change",
    )
    mode.add_argument("--defaults", action="store_true", help="print every option with its default, as YAML")
    mode.add_argument("--prepare", action="store_true", help="make once what a run needs on this machine")
    mode.add_argument("--version", action="store_true", help="print the version")
    options, surplus = parser.parse_known_args(argv)
    _check_arguments(options.input, surplus, names)
    if options.input and options.video:
        raise UserError(f"two videos were named, {options.input} and {options.video}: name one")
    options.video = options.input or options.video
    _refuse_unused_options(options)
    return options


def _check_arguments(video: Path | None, surplus: Sequence[str], names: Sequence[str]) -> None:
    """Raise UserError for an option that does not exist, a second argument, or a stage's name that is misspelt."""
    see = f"see {program_name()} --help"
    for argument in surplus:
        if argument.startswith("-"):
            raise UserError(f"unknown option {argument}: {see}")
    if video is None or (video.exists() and not surplus):
        return
    words = [str(video), *surplus]
    named = next((word for word in words if word in names), None)
    if named is not None:
        others = [word for word in words if word != named] or ["RUN"]
        raise UserError(f"the name of a stage is the first argument: {format_command(named, others[0])}; {see}")
    close = difflib.get_close_matches(str(video), names, n=1)
    if not video.exists() and (close or surplus):
        hint = f" (did you mean {close[0]}?)" if close else ""
        raise UserError(f"{video} is neither a stage{hint} nor a video: the stages are {', '.join(names)}; {see}")
    if surplus:
        raise UserError(f"one VIDEO is allowed, and {surplus[0]} is a second: quote a name that has spaces; {see}")


def _refuse_unused_options(options: argparse.Namespace) -> None:
    """Raise UserError for options that a command which runs nothing would ignore."""
    given = {
        "--run": options.run,
        "VIDEO": options.video,
        "--preset": options.preset,
        "--set": options.set,
        "--from": options.from_stage,
        "--force": options.force,
    }
    used = {
        "--status": ("--run", "VIDEO", "--preset", "--set"),
        "--verify": ("--run", "VIDEO"),
        "--defaults": (),
        "--prepare": (),
    }
    for mode, names in used.items():
        unused = [name for name, value in given.items() if value and name not in names]
        if getattr(options, mode.removeprefix("--")) and unused:
            raise UserError(f"{mode} runs nothing and does not use {unused[0]}: leave out {unused[0]}")


def _add_record_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--video", type=_path, help="video file or image folder; the run folder records it")
    parser.add_argument("--preset", help="name of a preset or a .yaml file; recorded, clears earlier --set")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="option; recorded")


def _path(text: str) -> Path:
    """Return the path of an argument; an empty one, such as of an unset variable, would mean the working directory."""
    if not text:
        raise argparse.ArgumentTypeError("the path is empty")
    return Path(text)


def _build_request(run_dir: Path, options: argparse.Namespace, replace_video: bool) -> RunRequest:
    return RunRequest(run_dir, options.video, options.preset, parse_overrides(options.set), replace_video)


class _Parser(argparse.ArgumentParser):
    """Parser whose errors are user errors."""

    def __init__(self, prog: str, description: str, epilog: str | None = None) -> None:
        super().__init__(prog=prog, description=description, epilog=epilog, allow_abbrev=False)

    def error(self, message: str) -> NoReturn:
        raise UserError(f"{message}: see {self.prog} --help")


def _run_with_exit_status(work: Callable[[], None], arguments: Sequence[str]) -> int:
    """Call `work` and print user errors in one sentence; faults of the program keep their traceback.

    arguments: of the command.
    """
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
            is_forced = any(argument.partition("=")[0] in ("--force", "--from") for argument in arguments)
            print(f"interrupted: {HOW_TO_RESUME[is_forced]}", file=sys.stderr)
        return EXIT_INTERRUPTED
    return 0


def _report_error(sentence: str) -> int:
    print(f"error: {sentence}", file=sys.stderr)
    send_event(error=sentence)
    return EXIT_USER_ERROR
