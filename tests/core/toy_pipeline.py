"""The toy pipeline in a folder of its own, run by its commands: in this process, or in new ones as a user would."""

import io
import os
import shutil
import signal
import subprocess
import sys
from contextlib import chdir, redirect_stderr, redirect_stdout
from pathlib import Path

from pipeline.core.cli import main_pipeline
from pipeline.core.events import EVENTS_VARIABLE
from pipeline.core.lock import LOCK_FD_VARIABLE, LOCK_PATH_VARIABLE
from pipeline.core.measure import REPOSITORY_DIR
from pipeline.core.parent import PARENT_PID_VARIABLE
from tests.core.toy.stages import PIPELINE

RUNNER_VARIABLES = (LOCK_FD_VARIABLE, LOCK_PATH_VARIABLE, PARENT_PID_VARIABLE, EVENTS_VARIABLE)


def user_environment() -> dict[str, str]:
    """The environment of this process without the variables that the runner sets for its children."""
    return {key: value for key, value in os.environ.items() if key not in RUNNER_VARIABLES}


class Toy:
    """A folder with the `stages` and `configs` of the toy and a video of numbers."""

    def __init__(self, folder: Path) -> None:
        shutil.copytree(REPOSITORY_DIR / "tests" / "core" / "toy", folder, ignore=shutil.ignore_patterns("__pycache__"))
        self.folder = folder
        self.video = folder / "numbers.txt"
        self.video.write_text("1 2 3000\n")
        self.run_dir = folder / "runs" / "a"

    def start(self, *arguments: str, **variables: str) -> subprocess.Popen[str]:
        """Start `python -m <arguments>` in a process group of its own; the caller waits."""
        environment = user_environment() | {"PYTHONPATH": str(REPOSITORY_DIR), **variables}
        command = [sys.executable, "-m", *arguments]
        pipe = subprocess.PIPE
        return subprocess.Popen(
            command,
            cwd=self.folder,
            env=environment,
            stdout=pipe,
            stderr=pipe,
            text=True,
            start_new_session=True,
            preexec_fn=_restore_sigint_handler,
        )

    def call(self, *arguments: str, **variables: str) -> subprocess.CompletedProcess[str]:
        """Run `python -m <arguments>` to its end."""
        process = self.start(*arguments, **variables)
        out, err = process.communicate(timeout=60)
        return subprocess.CompletedProcess(arguments, process.returncode, out, err)

    def stages(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Do what `python -m stages <arguments>` does, in this process."""
        out, err = io.StringIO(), io.StringIO()
        with chdir(self.folder), redirect_stdout(out), redirect_stderr(err):
            code = main_pipeline(PIPELINE, arguments, version="toy", isolate=False)
        return subprocess.CompletedProcess(arguments, code, out.getvalue(), err.getvalue())

    def all(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run all toy stages on runs/a in this process."""
        return self.stages("--run", "runs/a", *arguments)

    def call_all(self, *arguments: str, **variables: str) -> subprocess.CompletedProcess[str]:
        """Run all toy stages on runs/a by the command, in new processes."""
        return self.call("stages", "--run", "runs/a", *arguments, **variables)

    def expect_user_error(self, *arguments: str) -> str:
        """Run `python -m <arguments>`, in this process if it is the pipeline; return the error message."""
        in_process = arguments[0] == "stages"
        done = self.stages(*arguments[1:]) if in_process else self.call(*arguments)
        assert done.returncode == 2, done
        assert "Traceback" not in done.stderr
        (sentence,) = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
        assert done.stderr.splitlines()[-1] == sentence
        return sentence


def _restore_sigint_handler() -> None:
    """Undo that background jobs of a shell, and their children, ignore SIGINT."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
