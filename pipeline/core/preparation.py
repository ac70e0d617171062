"""What is made once on a machine: by `prepare_machine` after the installation, else beside the stages of the first run.

A module that prepares something has two functions: `is_prepared()`, which returns within milliseconds, and `prepare()`,
which stages may meet half-way: a stage that needs what is not there yet makes it or waits for it, so that a failure
here is met, and reported, by the stage.
"""

import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module

from pipeline.core.errors import UserError
from pipeline.core.parent import die_with_parent, die_with_parent_environment, import_path_environment


@contextmanager
def preparations(modules: Sequence[str]) -> Iterator[None]:
    """Prepare each module that is not prepared, in a process of its own, until the block ends."""
    missing = _missing(modules)
    if missing:
        print("first run on this machine: it prepares kernels and body model beside its work", file=sys.stderr)
    with _processes(missing, stderr=subprocess.DEVNULL):
        yield


def prepare_machine(modules: Sequence[str]) -> None:
    """Prepare each module that is not prepared, side by side, and wait for them.

    Raises:
        UserError: a module could not be prepared; its process has printed why.
    """
    with _processes(_missing(modules), stderr=None) as processes:
        failed = [module for module, process in processes.items() if process.wait() != 0]
    if failed:
        raise UserError(f"{failed[0]} could not be prepared: its error is above")


def _missing(modules: Sequence[str]) -> list[str]:
    return [module for module in modules if not import_module(module).is_prepared()]


@contextmanager
def _processes(modules: Sequence[str], stderr: int | None) -> Iterator[dict[str, "subprocess.Popen[bytes]"]]:
    """Start the preparation of each module in a process of its own; end those that still run after the block."""
    processes = {module: _start(module, stderr) for module in modules}
    try:
        yield processes
    finally:
        for process in processes.values():
            process.terminate()
        for process in processes.values():
            process.wait()


def _start(module: str, stderr: int | None) -> "subprocess.Popen[bytes]":
    return subprocess.Popen(
        [sys.executable, "-P", "-m", __name__, module],
        env=die_with_parent_environment() | import_path_environment(),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=stderr,
    )


if __name__ == "__main__":
    die_with_parent()
    try:
        import_module(sys.argv[1]).prepare()
    except UserError as error:
        raise SystemExit(f"error: {error}") from error
