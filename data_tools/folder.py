"""Folders that a command makes: whole or absent, and never over something that is there."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pipeline.core.errors import UserError


def require_absent(out: Path) -> None:
    """UserError when there is something at `out`: nothing is overwritten."""
    if out.exists():
        raise UserError(f"{out} exists already; remove it or name another folder")


@contextmanager
def atomic_folder(out: Path) -> Iterator[Path]:
    """Yield an empty folder beside `out`, which takes its name when the block ends without an error.

    What a killed command left there is removed by the next one. Raises UserError when `out` exists.
    """
    require_absent(out)
    part = out.with_name(f"{out.name}.part")
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(parents=True)
    yield part
    os.rename(part, out)
