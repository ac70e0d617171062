"""Frames whose body fit is usable, from `scores.npz` of the body stage."""

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Int

from pipeline.capture.capture import Capture
from pipeline.capture.frame_selection import TRAIN
from pipeline.core.command import rerun_command
from pipeline.core.errors import UserError
from pipeline.io.npz import load_npz

SCORES_NPZ = "scores.npz"


def usable_frames(capture: Capture, body_dir: Path) -> Bool[np.ndarray, "n"]:
    """Return which frames have a usable fit: the masks of the others may show someone or something else.

    Raises:
        UserError: the folder of the body stage does not hold this information.
    """
    path = body_dir / SCORES_NPZ
    usable = load_npz(path).get("usable")
    if usable is None or usable.shape != capture.split.shape:
        raise UserError(
            f"{path} does not say which of the {len(capture)} frames are usable (written by an older version); "
            f"run {rerun_command('body', body_dir)}"
        )
    return usable


def usable_positions(capture: Capture, body_dir: Path, split: int = TRAIN) -> Int[np.ndarray, "k"]:
    """Return the positions (0..n-1) of frames of one split with a usable fit: others neither train nor decide.

    Raises:
        UserError: as `usable_frames`.
    """
    return np.flatnonzero((capture.split == split) & usable_frames(capture, body_dir))
