"""Which frames of PeopleSnapshot InstantAvatar trains and tests on: first, last and step in its configuration.

Only subjects whose two sets share no frame are listed. Its validation frame is a test frame in each of them, so none is
named here and the frames stage takes some of the training frames.
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
    """The lists of `split.json`; None, with a warning, where the subject is not known or its video is shorter."""
    if subject not in _SPLITS:
        warn(f"no split is known for {subject}; the frames stage will hold out every eighth frame")
        return None
    train, heldout = _SPLITS[subject]
    if source.n_frames <= heldout[-1]:
        warn(
            f"{source.path} has {source.n_frames} frames, InstantAvatar's split of {subject} needs {heldout[-1] + 1}; "
            "the frames stage will hold out every eighth frame instead"
        )
        return None
    return {"train": train, "heldout": heldout}
