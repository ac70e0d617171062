"""Make the images of the README from a finished run: docs/images/sample.jpg and docs/images/filming.jpg.

python -m data_tools.sweep.pictures runs/sample
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from data_tools.command import run_command
from pipeline.capture.capture import load_capture
from pipeline.core.command import format_command
from pipeline.core.errors import UserError
from pipeline.io.image import read_rgb, to_uint8, write_rgb

FOLDER = Path("docs/images")
TILE_PX = 300
TURNTABLE_WIDTH_PX = 1600
LABEL_PX = 34
GREEN, RED, WHITE = (30, 140, 60), (190, 40, 40), (255, 255, 255)


def main(argv: Sequence[str]) -> None:
    """Write both images.

    Raises:
        UserError: the run has no report.
    """
    parser = argparse.ArgumentParser(
        prog="python -m data_tools.sweep.pictures", description="Make the images of the README from a finished run."
    )
    parser.add_argument("run", type=Path, help="run folder, for example runs/sample")
    run = parser.parse_args(argv).run
    turntable = run / "report" / "turntable.jpg"
    if not turntable.is_file():
        raise UserError(f"{turntable} does not exist; finish the run with {format_command('--run', run)}")
    views = read_rgb(turntable)
    views = views[: len(views) // 2]
    scale = TURNTABLE_WIDTH_PX / views.shape[1]
    write_rgb(FOLDER / "sample.jpg", cv2.resize(views, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))
    capture = load_capture(run / "frames")
    write_rgb(FOLDER / "filming.jpg", filming_sheet(to_uint8(capture.image(0)), capture.mask(0) > 0.5))
    print(f"{FOLDER}/sample.jpg and {FOLDER}/filming.jpg written from {run}")


def filming_sheet(image: UInt8[np.ndarray, "h w 3"], person: Bool[np.ndarray, "h w"]) -> UInt8[np.ndarray, "_ _ 3"]:
    """Return one good and three bad framings of a person, made from one image and its mask.

    Raises:
        UserError: the mask is empty.
    """
    rows = np.flatnonzero(person.any(axis=1))
    if len(rows) == 0:
        raise UserError("the first frame shows no person; choose another run")
    cut = image[: rows[0] + round(0.72 * (rows[-1] - rows[0]))]
    far = cv2.resize(image, None, fx=0.35, fy=0.35, interpolation=cv2.INTER_AREA)
    border = [(side - small) // 2 for side, small in zip(image.shape[:2], far.shape[:2], strict=True)]
    rest = [side - small - first for side, small, first in zip(image.shape[:2], far.shape[:2], border, strict=True)]
    far = cv2.copyMakeBorder(far, border[0], rest[0], border[1], rest[1], cv2.BORDER_REPLICATE)
    half = image.shape[1] // 4
    two = np.concatenate([image[:, half:-half], image[:, half:-half]], axis=1)
    tiles = [
        _tile(image, "whole body, arms apart", GREEN),
        _tile(cut, "feet cut off", RED),
        _tile(far, "too far away", RED),
        _tile(two, "two people", RED),
    ]
    return np.concatenate(tiles, axis=1)


def _tile(image: UInt8[np.ndarray, "_ _ 3"], label: str, colour: tuple[int, int, int]) -> UInt8[np.ndarray, "_ _ 3"]:
    """Return a square tile with the centre of the image and a label below it."""
    width = max(TILE_PX, round(image.shape[1] * TILE_PX / image.shape[0]))
    image = cv2.resize(image, (width, TILE_PX), interpolation=cv2.INTER_AREA)
    left = (width - TILE_PX) // 2
    square = image[:, left : left + TILE_PX]
    bar = np.full((LABEL_PX, TILE_PX, 3), colour, dtype=np.uint8)
    cv2.putText(bar, label, (10, 23), cv2.FONT_HERSHEY_SIMPLEX, 0.55, WHITE, 1, cv2.LINE_AA)
    return np.concatenate([square, bar], axis=0)


if __name__ == "__main__":
    raise SystemExit(run_command(main, sys.argv[1:]))
