"""Run the stages of a pipeline in order, each in a process of its own.

A process for each stage makes its peak memory measurable, returns its memory, and confines a crash to the stage. On
Linux the command forks itself, so that libraries are imported once and not by every stage; elsewhere, and from Python,
where the calling process may have threads that a fork would break, each stage starts an interpreter.
"""

import faulthandler
import multiprocessing
import os
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any, Literal

from pipeline.core.errors import EXIT_USER_ERROR, UserError
from pipeline.core.events import EVENTS_VARIABLE, parse_event
from pipeline.core.lock import RunLock
from pipeline.core.manifest import read_manifest
from pipeline.core.parent import import_path_environment
from pipeline.core.pipeline import Pipeline
from pipeline.core.preparation import preparations
from pipeline.core.progress import listen
from pipeline.core.run_folder import RunRequest, StageFailedError, StageKilledError, open_run
from pipeline.core.stage import StagePlan, discard_work_dir, plan_stage, run_stage

EXIT_INTERRUPTED = 130
_STDERR_DESCRIPTOR = 2
HOW_TO_RESUME = {
    False: "run the same command again to resume",
    True: "the same command starts over, because of --force or --from; without it, earlier results stay as they are",
}
"""What a user can do after an interruption, by whether results were to be made again."""


@dataclass(frozen=True)
class StageOutcome:
    """Result of one stage: whether it ran, and what its manifest says it cost, now or when it ran."""

    stage: str
    state: Literal["cached", "run"]
    seconds: float
    peak_rss_mib: float


@dataclass(frozen=True)
class Progress:
    """Progress of a pipeline.

    stage, number, count: name of the current stage, its number from 1, and the number of stages.
    state: "cached" (the result is fresh), "running" or "done".
    task, done, total: label of the current loop of the stage, its finished items and their number (None if unknown).
    """

    stage: str
    number: int
    count: int
    state: Literal["cached", "running", "done"]
    task: str = ""
    done: int = 0
    total: int | None = None


ProgressCallback = Callable[[Progress], None]
StageCommand = Callable[[list[str]], int]
"""The command of one stage: takes its arguments, returns the exit status."""


@dataclass(frozen=True)
class RunOptions:
    """How to run a pipeline.

    forced: names of the stages that run even if their result is fresh.
    isolate: whether each stage runs in a process of its own.
    progress: called when a stage starts or ends and several times a second while it runs. An exception that it raises
        stops the run; the next run resumes. None: standard output of the stages is passed on unchanged.
    fork_command: called in a fork of this process instead of starting an interpreter for each stage, on Linux and
        without `progress`; this process must not have run parallel code before.
    """

    forced: Sequence[str] = ()
    isolate: bool = True
    progress: ProgressCallback | None = None
    fork_command: StageCommand | None = None


def run_pipeline(pipeline: Pipeline, request: RunRequest, options: RunOptions) -> list[StageOutcome]:
    """Bring all stages of a run folder up to date, in order; a stage with a fresh result is skipped.

    Raises:
        UserError: the request, the configuration or the video is not valid, or a stage refused its input.
        StageFailedError: the process of a stage failed.
    """
    outcomes = []
    with open_run(request) as run:
        configs = pipeline.build_configs(run.record)
        with preparations(pipeline.preparations):
            for number, stage in enumerate(pipeline.load_stages(), start=1):
                with run.recorded_for(stage):
                    plan = plan_stage(stage, configs[stage.name], request.run_dir, run.record.video_path)
                    runner = _StageRunner(pipeline, plan, run.lock, options, number)
                    outcomes.append(runner.run())
    return outcomes


@dataclass(frozen=True)
class _StageRunner:
    """One stage in one run."""

    pipeline: Pipeline
    plan: StagePlan
    lock: RunLock
    options: RunOptions
    number: int

    def run(self) -> StageOutcome:
        """Bring the stage up to date."""
        name = self.plan.stage.name
        is_forced = name in self.options.forced
        is_fresh = self.plan.is_fresh() and not is_forced
        count = len(self.pipeline.names)
        print(f"[{self.number}/{count}] {name}{': cached' if is_fresh else ''}", file=sys.stderr, flush=True)
        self._report("cached" if is_fresh else "running")
        if is_fresh:
            discard_work_dir(self.plan)
        elif self.options.isolate:
            self._run_in_child(is_forced)
        else:
            self._run_here(is_forced)
        manifest = read_manifest(self.plan.folder)
        if manifest is None:
            raise UserError(f"{self.plan.folder} was removed during the run: run the same command again")
        if not is_fresh:
            self._report("done")
        if self.plan.stage.shows:
            print(f"      {self.plan.folder / self.plan.stage.shows}", file=sys.stderr, flush=True)
        return StageOutcome(name, "cached" if is_fresh else "run", manifest.seconds, manifest.peak_rss_mib)

    def _report(self, state: Literal["cached", "running", "done"], **loop: Any) -> None:
        if self.options.progress:
            count = len(self.pipeline.names)
            self.options.progress(Progress(self.plan.stage.name, self.number, count, state, **loop))

    def _run_here(self, is_forced: bool) -> None:
        def report_loop(label: str, done: int, total: int | None) -> None:
            self._report("running", task=label, done=done, total=total)

        with listen(report_loop) if self.options.progress else nullcontext():
            run_stage(self.plan, is_forced)

    def _run_in_child(self, is_forced: bool) -> None:
        """Run the stage by its command in a fork, or in an interpreter that imports what this process would import."""
        name = self.plan.stage.name
        arguments = [name, str(self.plan.run_dir), *(["--force"] if is_forced else [])]
        environment = self.lock.child_environment()
        if sys.platform == "linux" and self.options.fork_command and self.options.progress is None:
            self._check_exit_status(_run_in_fork(self.options.fork_command, arguments, environment), "")
            return
        command = [sys.executable, "-P", "-X", "faulthandler", "-m", self.pipeline.package, *arguments]
        environment |= import_path_environment()
        has_events = self.options.progress is not None
        if has_events:
            environment[EVENTS_VARIABLE] = "1"
        child = subprocess.Popen(
            command,
            env=environment,
            pass_fds=self.lock.passed_descriptors,
            stdout=subprocess.PIPE if has_events else None,
            text=True,
            encoding="utf-8",
        )
        try:
            message = self._forward_output(child)
            code = child.wait()
        except KeyboardInterrupt:
            child.wait()  # Ctrl-C reaches the child as well
            raise
        finally:
            _end(child)
        self._check_exit_status(code, message)

    def _forward_output(self, child: "subprocess.Popen[str]") -> str:
        """Report the events of a child and print its other output; return its error message, empty without one."""
        message = ""
        for line in child.stdout or ():
            event = parse_event(line)
            if event is None:
                print(line, end="")
            elif "error" in event:
                message = event["error"]
            else:
                self._report("running", task=event["label"], done=event["done"], total=event["total"])
        return message

    def _check_exit_status(self, code: int, message: str) -> None:
        name = self.plan.stage.name
        if code < 0:
            raise StageKilledError(
                f"stage {name} was killed by signal {-code} (9 often means that memory ran out): "
                f"{HOW_TO_RESUME[name in self.options.forced]}"
            )
        if code == EXIT_INTERRUPTED:
            raise KeyboardInterrupt
        if code == EXIT_USER_ERROR and message:
            raise UserError(message)
        if code:
            raise StageFailedError(name, code)


def _run_in_fork(command: StageCommand, arguments: list[str], environment: Mapping[str, str]) -> int:
    """Run a command in a fork of this process; return its exit status, negative if a signal killed it."""

    def run_command() -> None:
        os.environ.update(environment)
        faulthandler.enable(file=_STDERR_DESCRIPTOR)  # a crash of a library tells the line that called it
        sys.exit(command(arguments))

    child = multiprocessing.get_context("fork").Process(target=run_command)
    child.start()
    try:
        child.join()
    except KeyboardInterrupt:
        child.join()  # Ctrl-C reaches the child as well
        raise
    assert child.exitcode is not None  # it has ended
    return child.exitcode


def _end(child: "subprocess.Popen[str]") -> None:
    """Stop a child that is still running and close its output."""
    if child.poll() is None:
        child.terminate()
        child.wait()
    if child.stdout:
        child.stdout.close()


def format_summary(outcomes: Sequence[StageOutcome], wall_s: float) -> str:
    """Format the table at the end of a run; a cached stage shows what it cost when it ran.

    Args:
        wall_s: duration of the command, in seconds.
    """
    lines = [f"{'stage':<10} {'state':<7} {'seconds':>9} {'peak MiB':>9}"]
    lines += [f"{o.stage:<10} {o.state:<7} {o.seconds:>9.1f} {o.peak_rss_mib:>9.0f}" for o in outcomes]
    seconds, peak_mib = sum(o.seconds for o in outcomes), max((o.peak_rss_mib for o in outcomes), default=0.0)
    lines += [f"{'total':<10} {'':<7} {seconds:>9.1f} {peak_mib:>9.0f}", f"this command took {wall_s:.1f} s"]
    return "\n".join(lines)
