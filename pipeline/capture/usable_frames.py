"""`scores.npz` of the body stage: how well the body fits in each frame, and by that the frames to learn from."""

from pathlib import Path

import numpy as np
from jaxtyping import Int

from pipeline.capture.capture import Capture
from pipeline.capture.frame_selection import TRAIN
from pipeline.core.errors import UserError
from pipeline.io.npz import load_npz

SCORES_NPZ = "scores.npz"


def usable_training_positions(capture: Capture, body_dir: Path) -> Int[np.ndarray, "k"]:
    """Positions (0..n-1) of the training frames whose fit is usable: what field, mesh and texture learn from.

    Raises UserError when the body stage's folder does not tell which frames are usable.
    """
    path = body_dir / SCORES_NPZ
    usable = load_npz(path).get("usable")
    if usable is None or usable.shape != capture.split.shape:
        raise UserError(
            f"{path} does not tell which of the {len(capture)} frames are usable: an older version made it; "
            "run `python -m stages.body` again"
        )
    return np.flatnonzero((capture.split == TRAIN) & usable)
