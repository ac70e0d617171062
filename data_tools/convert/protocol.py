"""Training and test frames of PeopleSnapshot subjects in InstantAvatar's configuration (first, last, step).

Only subjects with disjoint splits are listed. The validation frame of InstantAvatar is a test frame in each subject, so
no validation split is defined here and the frames stage selects some of the training frames.
"""

from pipeline.capture.video import FrameSource
from pipeline.core.progress import warn

_SPLITS = {
    "female-3-casual": (range(0, 446, 4), range(446, 648, 4)),
    "female-4-casual": (range(0, 336, 4), range(335, 524, 4)),
    "female-4-sport": (range(1, 337, 4), range(336, 525, 4)),
    "male-3-casual": (range(0, 456, 4), range(456, 676, 4)),
    "male-3-sport": (range(1, 231, 2), range(230, 461, 6)),
    "male-4-casual": (range(0, 660, 6), range(660, 873, 6)),
}


def published_split(subject: str, source: FrameSource) -> dict[str, range] | None:
    """Return the split of a subject; None, with a warning, if the subject is unknown or its video is too short."""
    if subject not in _SPLITS:
        warn(f"no published split for {subject}: the frames stage will hold out every eighth frame")
        return None
    train, heldout = _SPLITS[subject]
    if source.n_frames <= heldout[-1]:
        warn(
            f"{source.path} has {source.n_frames} frames, InstantAvatar's split of {subject} needs {heldout[-1] + 1}: "
            "the frames stage will hold out every eighth frame instead"
        )
        return None
    return {"train": train, "heldout": heldout}
