"""Running a pipeline from Python: progress, errors and cancellation, with stages in child processes and in this one."""

import os
import re
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from pipeline.core.cli import main_pipeline
from pipeline.core.errors import UserError
from pipeline.core.events import EVENTS_VARIABLE, parse_event, send_event
from pipeline.core.manifest import read_manifest
from pipeline.core.pipeline import Pipeline
from pipeline.core.run_folder import RunRequest, StageFailedError
from pipeline.core.runner import Progress, RunOptions, StageCommand, StageOutcome, run_pipeline
from tests.core.toy.stages import PIPELINE
from tests.core.toy_pipeline import Toy

LEARN_STEPS = 20


def run_toy(toy: Toy, isolate: bool, progress: list[Progress]) -> list[StageOutcome]:
    request = RunRequest(toy.run_dir, toy.video, overrides={"learn.steps": LEARN_STEPS})
    return run_pipeline(PIPELINE, request, RunOptions(isolate=isolate, progress=progress.append))


@pytest.mark.parametrize("isolate", [True, False])
def test_progress_reports_stages_and_loops(toy: Toy, isolate: bool) -> None:
    calls: list[Progress] = []
    outcomes = run_toy(toy, isolate, calls)
    assert [(outcome.stage, outcome.state) for outcome in outcomes] == [(name, "run") for name in PIPELINE.names]
    assert calls[0] == Progress("read", 1, 3, "running")
    assert Progress("learn", 2, 3, "running", "learning", LEARN_STEPS, LEARN_STEPS) in calls
    assert calls[-1] == Progress("summarise", 3, 3, "done")
    calls.clear()
    run_toy(toy, isolate, calls)
    assert calls == [Progress(name, number, 3, "cached") for number, name in enumerate(PIPELINE.names, start=1)]


@pytest.mark.parametrize("isolate", [True, False])
def test_a_user_error_of_a_stage_is_raised_with_its_message(toy: Toy, isolate: bool) -> None:
    toy.video.write_text("1 two 3")
    with pytest.raises(UserError, match=r"numbers\.txt holds two, which is not a number: remove it"):
        run_toy(toy, isolate, [])
    assert not toy.run_dir.exists()


@pytest.mark.parametrize("isolate", [True, False])
def test_an_exception_of_the_callback_stops_the_run(toy: Toy, isolate: bool) -> None:
    """The finished stages stay; the next run resumes."""

    def cancel(progress: Progress) -> None:
        if progress.stage == "learn":
            raise TimeoutError("the user has no time")

    request = RunRequest(toy.run_dir, toy.video)
    with pytest.raises(TimeoutError):
        run_pipeline(PIPELINE, request, RunOptions(isolate=isolate, progress=cancel))
    assert read_manifest(toy.run_dir / "read") is not None
    assert read_manifest(toy.run_dir / "learn") is None
    assert [outcome.state for outcome in run_toy(toy, isolate, [])] == ["cached", "run", "run"]


def test_a_crash_of_a_stage_is_not_a_user_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    package = tmp_path / "crashing"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "__main__.py").write_text("print('output of a library')\nraise SystemExit(3)\n")
    (package / "one.py").write_text(
        "from pipeline.core.config import Config\nfrom pipeline.core.stage import Stage\n"
        "STAGE = Stage('one', 1, (), (), Config, lambda inputs, out, config: {})\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    pipeline = Pipeline("crashing", ("one",), config_dir=tmp_path)
    with pytest.raises(StageFailedError, match="stage one ended with exit status 3") as caught:
        run_pipeline(pipeline, RunRequest(tmp_path / "run"), RunOptions(progress=lambda _: None))
    assert caught.value.code == 3
    assert "output of a library" in capfd.readouterr().out


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux forks")
def test_the_command_runs_each_stage_in_a_fork(toy: Toy) -> None:
    """What the parent has imported or set is there; nothing that the stage changes comes back."""
    marks = ["set before the fork"]

    def command(arguments: list[str]) -> int:
        marks.append("changed in the fork")
        (toy.folder / arguments[0]).write_text(f"{os.getppid()} {marks[0]}")
        return main_pipeline(PIPELINE, arguments)

    options = RunOptions(fork_command=command)
    outcomes = run_pipeline(PIPELINE, RunRequest(toy.run_dir, toy.video), options)
    assert [outcome.state for outcome in outcomes] == ["run"] * 3
    for name in PIPELINE.names:
        assert (toy.folder / name).read_text() == f"{os.getpid()} set before the fork"
    assert marks == ["set before the fork"]


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux forks")
@pytest.mark.parametrize(
    ("command", "error", "message"),
    [
        (lambda _: 3, StageFailedError, "stage read ended with exit status 3"),
        (lambda _: os.kill(os.getpid(), signal.SIGKILL), UserError, r"read was killed by signal 9 \(9 often means"),
    ],
)
def test_a_fork_that_fails_names_its_stage(
    toy: Toy, command: StageCommand, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        run_pipeline(PIPELINE, RunRequest(toy.run_dir, toy.video), RunOptions(fork_command=command))


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux forks")
def test_a_fork_that_crashes_prints_where(toy: Toy, capfd: pytest.CaptureFixture[str]) -> None:
    def crash(_: Sequence[str]) -> int:
        os.kill(os.getpid(), signal.SIGSEGV)
        return 0

    with pytest.raises(UserError, match="stage read was killed by signal 11"):
        run_pipeline(PIPELINE, RunRequest(toy.run_dir, toy.video), RunOptions(fork_command=crash))
    assert re.search(r"Segmentation fault[\s\S]*test_runner.py\", line \d+ in crash", capfd.readouterr().err)


def test_events_are_lines_of_their_own(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    send_event(error="nobody listens")
    assert capsys.readouterr().out == ""
    monkeypatch.setenv(EVENTS_VARIABLE, "1")
    send_event(label="a\nb", done=1, total=None)
    line, rest = capsys.readouterr().out.split("\n")
    assert (parse_event(line), rest) == ({"label": "a\nb", "done": 1, "total": None}, "")
    assert parse_event("output of a library") is None


def test_a_stage_alone_refuses_results_that_do_not_belong_together(toy: Toy) -> None:
    toy.all("--video", "numbers.txt", "--set", "summarise.word=value")
    toy.video.write_text("4 5\n")
    toy.stages("read", "runs/a")
    sentence = toy.expect_user_error("stages", "summarise", "runs/a", "--set", "summarise.word=number")
    assert "runs/a/learn was made from another result of read" in sentence
    assert sentence.endswith("python -m stages --run runs/a")
    assert toy.all().returncode == 0
    assert toy.stages("summarise", "runs/a").stdout == "runs/a/summarise: cached\n"
