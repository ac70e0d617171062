"""Convert one subject of a research data set to a video folder of the pipeline.

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
from pipeline.core.command import format_command
from pipeline.core.errors import UserError


class Format(NamedTuple):
    """Functions that recognise and read a folder of one format."""

    recognise: Callable[[Path], bool]
    read: Callable[[Path], Recording]


# In order of detection: the last formats are the most general.
FORMATS = {
    "peoplesnapshot": Format(is_people_snapshot, read_people_snapshot),
    "instantavatar": Format(is_instant_avatar, read_instant_avatar),
    "neuman": Format(is_neuman, read_neuman),
    "images": Format(is_image_folder, read_image_folder),
}


def main(argv: Sequence[str]) -> None:
    """Convert one folder."""
    parser = argparse.ArgumentParser(prog="python -m data_tools.convert", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("format", nargs="?", help=f"{', '.join(FORMATS)}; detected if omitted")
    parser.add_argument("source", type=Path, help="folder of one subject; read only")
    parser.add_argument("target", type=Path, help="new video folder")
    options = parser.parse_args(argv)
    source, target = options.source, options.target
    require_absent(target)
    if not source.is_dir():
        raise UserError(
            f"{source} is not a folder; name the folder of one subject (a single video needs no conversion)"
        )
    if target.resolve().is_relative_to(source.resolve()):
        raise UserError(f"{target} is inside {source}, which is read only; choose a target outside it")
    name = options.format or detect_format(source)
    if name not in FORMATS:
        raise UserError(f"unknown format {name}; choose one of {', '.join(FORMATS)}")
    recording = FORMATS[name].read(source)
    write_recording(recording, target)
    print(f"{target} ({name}): {recording.summary()}; next: {format_command(target)}")


def detect_format(source: Path) -> str:
    """Return the first format that recognises the folder. UserError if there is none."""
    name = next((name for name, format_ in FORMATS.items() if format_.recognise(source)), None)
    if name is None:
        raise UserError(f"{source} has none of the formats {', '.join(FORMATS)}; a single video needs no conversion")
    return name


if __name__ == "__main__":
    raise SystemExit(run_command(main, sys.argv[1:]))
