"""Make a plain video folder of what a researcher has on disk.

python -m data_tools.convert [FORMAT] SOURCE TARGET, then make all VIDEO=TARGET
"""

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from data_tools.command import run_command
from data_tools.convert.image_folder import is_image_folder, read_image_folder
from data_tools.convert.instant_avatar import is_instant_avatar, read_instant_avatar
from data_tools.convert.neuman import is_neuman, read_neuman
from data_tools.convert.people_snapshot import is_people_snapshot, read_people_snapshot
from data_tools.convert.recording import Recording, write_recording
from data_tools.folder import require_absent
from pipeline.core.errors import UserError


class Format(NamedTuple):
    """How a folder of a format is recognised and read."""

    recognise: Callable[[Path], bool]
    read: Callable[[Path], Recording]


# In the order in which they are tried: the last ones fit more folders.
FORMATS = {
    "peoplesnapshot": Format(is_people_snapshot, read_people_snapshot),
    "instantavatar": Format(is_instant_avatar, read_instant_avatar),
    "neuman": Format(is_neuman, read_neuman),
    "images": Format(is_image_folder, read_image_folder),
}


def main(argv: Sequence[str]) -> None:
    """Convert one folder."""
    parser = argparse.ArgumentParser(prog="python -m data_tools.convert", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("format", nargs="?", help=f"{', '.join(FORMATS)}; guessed when left out")
    parser.add_argument("source", type=Path, help="folder of one subject; it is only read")
    parser.add_argument("target", type=Path, help="folder to make")
    options = parser.parse_args(argv)
    source, target = options.source, options.target
    require_absent(target)
    if not source.is_dir():
        raise UserError(f"{source} is no folder; give one subject's folder (a video alone needs no conversion)")
    if target.resolve().is_relative_to(source.resolve()):
        raise UserError(f"{target} lies in {source}, which is only read; name a folder elsewhere")
    name = options.format or guess_format(source)
    if name not in FORMATS:
        raise UserError(f"unknown format {name}; there are {', '.join(FORMATS)}")
    recording = FORMATS[name].read(source)
    write_recording(recording, target)
    print(f"{target} ({name}): {recording.summary()}; next: make all VIDEO={target}")


def guess_format(source: Path) -> str:
    """The first format that recognises the folder. UserError when none does."""
    name = next((name for name, format_ in FORMATS.items() if format_.recognise(source)), None)
    if name is None:
        raise UserError(f"{source} has none of the known formats ({', '.join(FORMATS)}); a video alone needs none")
    return name


if __name__ == "__main__":
    raise SystemExit(run_command(main, sys.argv[1:]))
