"""What a recording must show before any work is spent on it, and what a run goes on without."""

from pathlib import Path

import numpy as np

from pipeline.avatar.person import legs_in_image
from pipeline.core.errors import UserError
from pipeline.core.progress import warn
from pipeline.io.sightings import Sightings

_BLACK_LEVEL = 8
_FEET = (29, 30, 31, 32)
# A shoe reaches this share of the image's height below the joints of heel and toe.
_SOLE_SHARE = 0.02
_UNSEEN_ARC_DEG = 120.0


def refuse_bad_input(sightings: Sightings, path: Path, min_frames: int) -> None:
    """Raise UserError for a recording from which no avatar can come: black, no person, several, or cut off."""
    if sightings.grays.max(axis=(1, 2)).max() < _BLACK_LEVEL:
        raise UserError(f"all frames of {path} are black; give a recording in which the person can be seen")
    # Twice, because one frame may show a picture on a wall or a reflection.
    crowded = sightings.frame_index[sightings.n_people > 1]
    if len(crowded) >= 2:
        raise UserError(
            f"{path} shows several people (for example in frame {crowded[0]}); "
            "give a recording of one person alone, or crop it to one"
        )
    n_found, n_looked_at = int(sightings.found.sum()), len(sightings.found)
    if n_found == 0:
        raise UserError(f"no person was found in {path}; the whole body should be visible and fill half of the height")
    if n_found < min_frames:
        raise UserError(
            f"a person was found in only {n_found} of {n_looked_at} frames of {path}; {min_frames} are needed"
        )
    found = sightings.found
    legs = legs_in_image(sightings.landmarks_px[found], sightings.landmarks_visibility[found], sightings.height)
    if legs.mean() < 0.5:
        first = sightings.frame_index[found][~legs][0]
        raise UserError(
            f"the person in {path} is cut off above the feet in {np.sum(~legs)} of {n_found} frames "
            f"(frame {first} first); film the whole body from head to feet"
        )


def warn_of_gaps(sightings: Sightings, unseen_rad: float, path: Path) -> None:
    """Say what the run goes on without."""
    missing = int((~sightings.found).sum())
    if missing:
        warn(f"{missing} of {len(sightings.found)} frames of {path} show no person and are dropped")
    feet_px = sightings.landmarks_px[sightings.found][:, _FEET, 1]
    cropped = int((feet_px.max(axis=1) > (1.0 - _SOLE_SHARE) * sightings.height).sum())
    if cropped:
        warn(f"the feet are cut off in {cropped} frames of {path}; they will be less sharp in the avatar")
    if unseen_rad > np.radians(_UNSEEN_ARC_DEG):
        warn(
            f"the person in {path} is never seen from {np.degrees(unseen_rad):.0f} degrees of the full turn; "
            "that side will be guessed (film a full turn to see it)"
        )
