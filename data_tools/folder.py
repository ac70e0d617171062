"""Create output folders atomically, without overwriting."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pipeline.core.errors import UserError


def require_absent(out: Path) -> None:
    """Raise UserError if `out` exists."""
    if out.exists():
        raise UserError(f"{out} already exists; remove it or choose another folder")


@contextmanager
def atomic_folder(out: Path) -> Iterator[Path]:
    """Yield the empty folder `OUT.part`, which is renamed to `out` when the block ends without an error.

    The remains of a killed command are removed. Raises UserError if `out` exists.
    """
    require_absent(out)
    with replaced_folder(out) as part:
        yield part


@contextmanager
def replaced_folder(out: Path) -> Iterator[Path]:
    """Yield the empty folder `OUT.part`, which replaces `out` when the block ends without an error.

    The remains of a killed command are removed. A kill during the replacement may leave no folder, never a partial one.
    """
    part = out.with_name(f"{out.name}.part")
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(parents=True)
    yield part
    if out.exists():
        shutil.rmtree(out)
    os.rename(part, out)
