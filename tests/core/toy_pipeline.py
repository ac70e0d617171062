"""The toy pipeline, run as a user would run the real one: by its commands, in a folder of its own."""

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

from pipeline.core.lock import LOCK_FD_VARIABLE, PARENT_PID_VARIABLE
from pipeline.core.measure import REPOSITORY_DIR


def user_environment() -> dict[str, str]:
    """This process's environment as a user's shell would have it: not inside a run."""
    return {key: value for key, value in os.environ.items() if key not in (LOCK_FD_VARIABLE, PARENT_PID_VARIABLE)}


class Toy:
    """A folder with the toy's `stages` and `configs`, a video of numbers, and the commands."""

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

    def all(self, *arguments: str, **variables: str) -> subprocess.CompletedProcess[str]:
        """Run the whole toy pipeline on runs/a."""
        return self.call("stages", "--run", "runs/a", *arguments, **variables)

    def expect_user_error(self, *arguments: str) -> str:
        """The one sentence with which a command is refused."""
        done = self.call(*arguments)
        assert done.returncode == 2, done
        assert "Traceback" not in done.stderr
        (sentence,) = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
        assert done.stderr.splitlines()[-1] == sentence
        return sentence


def _restore_sigint_handler() -> None:
    """A shell's background jobs ignore SIGINT, and so would their children; a user at a terminal is what is tested."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
