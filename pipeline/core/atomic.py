"""Files that are whole or absent: written beside their place, flushed to disk, then renamed."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path in the same folder; when the block ends without an error it becomes `path`.

    For checkpoints (`checkpoint*` in a stage's folder) and for small files that are rewritten in place. The temporary
    name keeps the suffix, which many writers look at.
    """
    temporary_path = path.with_name(f"unfinished-{path.name}")
    try:
        yield temporary_path
        fsync_path(temporary_path)
        temporary_path.replace(path)
    finally:
        temporary_path.unlink(missing_ok=True)


def fsync_path(path: Path) -> None:
    """Push a file's content, or a folder's entries, through to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
