"""Alignment of frames that are not trained on to the outline of the mesh; no colours are used."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool

from pipeline.body.body import Body, Motion
from pipeline.body.pose_correction import corrections_between
from pipeline.mesh.correction_prior import prior_given_others
from pipeline.mesh.pose_alignment import AlignedSurface, align_motion
from pipeline.mesh.views import PosedView

ITERATIONS = 3
"""Gauss-Newton steps at each size of the masks."""
PRIOR_WIDTH = 1.5
"""Deviations of the prior over those of the known corrections, which priors of their own have made smaller."""


def align_outlines(
    surface: AlignedSurface,
    body: Body,
    motions: tuple[Motion, Motion],
    is_known: Bool[np.ndarray, "n"],
    views: Sequence[PosedView],
) -> Motion:
    """Return the motion with the poses of all frames but the known ones aligned to the outlines of their masks.

    Pose errors of the fit are alike in neighbouring frames, and as large in these frames as in the known ones: the
    prior has the deviations and the correlation time of the known corrections, and is narrow between frames that are
    close in time (`prior_given_others`).

    Args:
        surface: without colours.
        body: joint hierarchy.
        motions: as fitted to the body alone, and with corrections, interpolated where they are not known.
        is_known: frames with poses of their own; at least one.
        views: masks of all other frames, in order of time; their poses are not read.
    """
    fitted, corrected = motions
    free, known = np.flatnonzero(~is_known), np.flatnonzero(is_known)
    if len(free) == 0:
        return corrected
    learnt = corrections_between(body, fitted.select(known), corrected.select(known))
    prior = prior_given_others(corrected.time_s.astype(np.float64), is_known, PRIOR_WIDTH * learnt)
    aligned = align_motion(surface, body, corrected.select(free), views, prior, ITERATIONS)
    return corrected.with_poses_at(free, aligned)
