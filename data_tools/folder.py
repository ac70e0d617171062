"""Create output folders atomically, without overwriting what is the user's."""

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pipeline.core.errors import UserError
from pipeline.core.json_file import load_json
from pipeline.core.manifest import digest_file

WRITTEN_FILE = ".written.json"
"""File of a result with the SHA-256 of each of its files by name, by which the user's files and edits are known."""


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

    Files and folders in `out` that the new one does not have are the user's and stay, unless `WRITTEN_FILE` names them.
    The remains of a killed command are removed, or replace `out` where the command was about to do so.
    """
    part, replaced = (out.with_name(f"{out.name}.{suffix}") for suffix in ("part", "replaced"))
    _retire(replaced, out)
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(parents=True)
    yield part
    if out.exists():
        os.rename(out, replaced)
    os.rename(part, out)
    _retire(replaced, out)


@contextmanager
def result_folder(out: Path) -> Iterator[Path]:
    """Yield a folder that replaces `out` as `replaced_folder` does; what the user has edited in `out` is kept, too.

    Raises:
        UserError: a file of an earlier result was edited, or one of the user's has the name of a file of the new one.
    """
    written = _read_written(out)
    for name, digest in written.items():
        if (out / name).is_file() and digest_file(out / name) != digest:
            raise _kept_error(out / name)
    with replaced_folder(out) as part:
        yield part
        made = {path.name: digest_file(path) for path in part.iterdir() if path.is_file()}
        for name in made:
            if written and name not in written and (out / name).exists():
                raise _kept_error(out / name)
        (part / WRITTEN_FILE).write_text(json.dumps(made, indent=2) + "\n", encoding="utf-8")


def _retire(replaced: Path, out: Path) -> None:
    """Remove the folder that was replaced, if there is one; the user's files in it move to the new one."""
    if not replaced.is_dir():
        return
    if not out.exists():  # killed between the two renames
        os.rename(replaced, out)
        return
    written = _read_written(replaced)
    for path in list(replaced.iterdir()):
        if path.name not in written and not (out / path.name).exists():
            os.rename(path, out / path.name)
    shutil.rmtree(replaced)


def _read_written(folder: Path) -> dict[str, Any]:
    """Return the digests in `WRITTEN_FILE`; empty for a folder without one. UserError if it is damaged."""
    path = folder / WRITTEN_FILE
    try:
        return dict(load_json(path)) if path.is_file() else {}
    except (ValueError, TypeError):
        raise UserError(f"{path} is damaged: move the files that you need out of {folder} and remove it") from None


def _kept_error(path: Path) -> UserError:
    return UserError(f"{path} was edited and would be replaced: move it, or name the new result otherwise with --name")
