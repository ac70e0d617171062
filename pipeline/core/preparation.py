"""What the first run after an installation makes once, in processes beside the stages of the run.

A module that prepares something has two functions: `is_prepared()`, which returns within milliseconds, and `prepare()`,
which stages may meet half-way: a stage that needs what is not there yet makes it or waits for it, so that a failure
here is met, and reported, by the stage.
"""

import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module

from pipeline.core.parent import die_with_parent, die_with_parent_environment, import_path_environment


@contextmanager
def preparations(modules: Sequence[str]) -> Iterator[None]:
    """Prepare each module that is not prepared, in a process of its own, until the block ends."""
    missing = [module for module in modules if not import_module(module).is_prepared()]
    if missing:
        print("first run on this machine: it prepares kernels and body model beside its work", file=sys.stderr)
    processes = [_start(module) for module in missing]
    try:
        yield
    finally:
        for process in processes:
            process.terminate()
        for process in processes:
            process.wait()


def _start(module: str) -> "subprocess.Popen[bytes]":
    return subprocess.Popen(
        [sys.executable, "-P", "-m", __name__, module],
        env=die_with_parent_environment() | import_path_environment(),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


if __name__ == "__main__":
    die_with_parent()
    import_module(sys.argv[1]).prepare()
