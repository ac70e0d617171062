"""Give the avatar of a finished run a painted diffuse map.

python -m data_tools.retexture RUN --diffuse PAINT.png [--name NAME]

PAINT.png has the layout of RUN/texture/diffuse.png, any square size; its alpha says where the paint applies. Writes
RUN/retexture/NAME/: avatar.glb, avatar.obj with its maps, diffuse.png.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from data_tools.command import run_command
from data_tools.edited_avatar import load_editable_avatar, write_edited_avatar
from data_tools.pose import check_folder_name
from pipeline.texture.painting import paint_over, read_painting


def main(argv: Sequence[str]) -> None:
    """Write one edited avatar."""
    options = _parse_options(argv)
    name = check_folder_name(options.name) if options.name else options.diffuse.stem
    painting = read_painting(options.diffuse)
    avatar = load_editable_avatar(options.run)
    write_edited_avatar(avatar, paint_over(avatar.scene.texture, painting), options.run / "retexture" / name)


def _parse_options(argv: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m data_tools.retexture", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("run", type=Path, help="run folder with a finished export")
    parser.add_argument("--diffuse", type=Path, required=True, help="painted map in the layout of texture/diffuse.png")
    parser.add_argument("--name", help="of the folder RUN/retexture/NAME; default: that of the painted map")
    return parser.parse_args(argv)


if __name__ == "__main__":
    raise SystemExit(run_command(main, sys.argv[1:]))
