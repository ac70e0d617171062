"""How ragged masks are, and a warning about supplied ones with holes, specks or a frayed outline."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from pipeline.capture.capture import Capture
from pipeline.capture.frame_selection import evenly_spaced
from pipeline.core.progress import warn

_SAMPLED_FRAMES = 24
# Half the window of the median that smooths a mask, as a fraction of the person's height: strands of hair and fingers
# are lost, which is all that a clean mask loses.
_WINDOW_FRACTION = 0.006
# Clean masks, made by the pipeline or rendered, have 0.005 to 0.015; masks from a colour threshold 0.04.
MAX_RAGGED_SHARE = 0.02


def ragged_share(mask: Float[np.ndarray, "h w"]) -> float:
    """Return the part of a mask that changes when it is smoothed, over its area; 0 without a person.

    mask: in [0, 1].
    """
    person = mask > 0.5
    rows = np.flatnonzero(person.any(axis=1))
    if not len(rows):
        return 0.0
    side_px = 2 * max(1, round(_WINDOW_FRACTION * (rows[-1] - rows[0] + 1))) + 1
    smooth = cv2.medianBlur(255 * person.astype(np.uint8), side_px) > 127
    return float((smooth != person).sum() / person.sum())


def assess_supplied_masks(capture: Capture, path: Path) -> None:
    """Warn if the supplied masks of a recording are ragged. path: of the recording."""
    sampled = evenly_spaced(len(capture), _SAMPLED_FRAMES)
    share = float(np.median([ragged_share(capture.mask(position)) for position in sampled]))
    if share > MAX_RAGGED_SHARE:
        warn(
            f"the masks in {capture.mask_source} of {path} have holes, specks or frayed outlines ({share:.1%} of them "
            "change when they are smoothed), and pictures are compared inside them: scores will be low. Masks are "
            f"made from the pictures where none are supplied: use a copy without {capture.mask_source}"
        )
