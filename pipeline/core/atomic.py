"""Atomic files: written under a temporary name, flushed to disk, then renamed. A reader sees all of a file or none."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path in the folder of `path`; rename it to `path` when the block ends without an error.

    For checkpoints (`checkpoint*` in the folder of a stage) and for small files that are replaced. The temporary name
    keeps the suffix, from which many writers derive the format.
    """
    temporary_path = path.with_name(f"unfinished-{path.name}")
    try:
        yield temporary_path
        fsync_path(temporary_path)
        temporary_path.replace(path)
    finally:
        temporary_path.unlink(missing_ok=True)


def fsync_path(path: Path) -> None:
    """Flush the content of a file, or the entries of a folder, to disk."""
    flags = os.O_RDONLY
    if sys.platform == "win32":  # where a folder cannot be flushed, and a file needs a writable descriptor
        if path.is_dir():
            return
        flags = os.O_RDWR
    descriptor = os.open(path, flags)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
