"""Give the avatar of a finished run the palette of a painting, without any network.

python -m data_tools.stylise RUN --look IMAGE [--name NAME]

Writes RUN/stylise/NAME/: avatar.glb, avatar.obj with its maps, diffuse.png.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from data_tools.command import run_command
from data_tools.edited_avatar import load_editable_avatar, write_edited_avatar
from data_tools.pose import check_folder_name
from pipeline.core.errors import UserError
from pipeline.geometry.atlas import rasterize_texels
from pipeline.io.image import read_alpha, read_rgb_float
from pipeline.texture.painting import replace_diffuse
from pipeline.texture.palette import transfer_palette

MAX_TRANSPARENT = 127
"""Alpha (of 255) up to which a pixel is transparent."""


def main(argv: Sequence[str]) -> None:
    """Write one edited avatar."""
    options = _parse_options(argv)
    name = check_folder_name(options.name) if options.name else options.look.stem
    look = read_look(options.look)
    avatar = load_editable_avatar(options.run)
    texture = avatar.scene.texture
    covered = rasterize_texels(texture.atlas, len(texture.diffuse)).coverage_mask()
    styled = replace_diffuse(texture, transfer_palette(texture.diffuse, covered, look))
    write_edited_avatar(avatar, styled, options.run / "stylise" / name)


def read_look(path: Path) -> Float[np.ndarray, "1 n 3"]:
    """Read the colours of the opaque pixels of a picture, as one row: what is transparent has no colour.

    Raises:
        UserError: the file cannot be read, or is transparent everywhere.
    """
    colours = read_rgb_float(path)[read_alpha(path) > MAX_TRANSPARENT]
    if not len(colours):
        raise UserError(f"image {path} is transparent everywhere; choose a picture with opaque pixels")
    return colours[None]


def _parse_options(argv: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m data_tools.stylise", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("run", type=Path, help="run folder with a finished export")
    parser.add_argument("--look", type=Path, required=True, help="picture whose palette the avatar gets")
    parser.add_argument("--name", help="of the folder RUN/stylise/NAME; default: that of the picture")
    return parser.parse_args(argv)


if __name__ == "__main__":
    raise SystemExit(run_command(main, sys.argv[1:]))
