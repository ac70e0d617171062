"""Legs that something in front of the person hides: a box, a table, a chair.

The detector guesses their landmarks, mostly onto the other leg: 440 mm off (median) at visibilities of 0.1 to 0.2. Of a
leg behind the other one it is right to 30 to 60 mm at any visibility, so that a single visibility tells little; one
that is low for knee or ankle and stays low tells more. What hides arms is mostly the trunk: their guesses are kept.
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.body.fit.linear_body import ACTIVE_JOINTS
from pipeline.capture.landmarks import ANKLES, FEET, KNEES

KNEE_AND_ANKLE = tuple(zip(KNEES, ANKLES, strict=True))
"""Landmarks of the left and the right leg whose visibility is judged."""

LEG_LANDMARKS = tuple((*judged, *FEET[side::2]) for side, judged in enumerate(KNEE_AND_ANKLE))
"""Knee, ankle, heel and tip of the foot of the left and the right leg."""

LEG_JOINTS = ("UpLeg", "Leg", "Foot", "ToeBase")

HALF_WINDOW_S = 0.11
"""Time before and after a frame in which a leg that is hidden once counts as hidden."""

HIDDEN_VISIBILITY, SHOWN_VISIBILITY = 0.2, 0.5
"""Lowest visibility of knee and ankle in the window: a leg is hidden up to the first and shown from the second on."""

MIN_SHOWN = 1e-3
"""Least factor: a hidden leg follows the posture of the recording and the frames before and after."""

FULL_OUTLINE_CONFIDENCE = 0.2
"""Confidence of knee and ankle from which the outline of a leg has its full weight."""


def leg_visibility_factor(
    visibility: Float[np.ndarray, "n 33"], time_s: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n 33"]:
    """Return a factor in [`MIN_SHOWN`, 1] on the confidence of each landmark: small on legs that an object hides.

    visibility: nan where nothing was detected; that hides no leg.
    """
    factor = np.ones_like(visibility)
    is_near = np.abs(time_s[:, None] - time_s[None]) <= HALF_WINDOW_S
    for judged, landmarks in zip(KNEE_AND_ANKLE, LEG_LANDMARKS, strict=True):
        lowest = np.nan_to_num(visibility[:, list(judged)], nan=1.0).min(1)
        lowest = np.where(is_near, lowest, np.inf).min(1)
        shown = (lowest - HIDDEN_VISIBILITY) / (SHOWN_VISIBILITY - HIDDEN_VISIBILITY)
        factor[:, list(landmarks)] = np.clip(shown, MIN_SHOWN, 1.0)[:, None]
    return factor


def hidden_leg_share(visibility: Float[np.ndarray, "n 33"], time_s: Float[np.ndarray, "n"]) -> float:
    """Return the share of frames in which a leg is hidden (0 to 1). visibility: nan where nothing was detected."""
    knees = [landmarks[0] for landmarks in LEG_LANDMARKS]
    factor = leg_visibility_factor(visibility, time_s)[:, knees]
    return float((factor <= MIN_SHOWN).any(1).mean())


def outline_weights(confidence: Float[Tensor, "n l"]) -> Float[Tensor, "n j"]:
    """Return the weight (0 to 1) of the outline of each active joint: that of hidden legs says where the object ends.

    confidence: of the landmarks (`Observations`); frames in which no leg was detected have weight 1.
    """
    weight = torch.ones(len(confidence), len(ACTIVE_JOINTS), dtype=confidence.dtype)
    for side, judged in zip(("Left", "Right"), KNEE_AND_ANKLE, strict=True):
        known = confidence[:, list(judged)].min(1).values
        shown = torch.where(known > 0.0, (known / FULL_OUTLINE_CONFIDENCE).clamp(max=1.0), 1.0)
        weight[:, [ACTIVE_JOINTS.index(side + name) for name in LEG_JOINTS]] = shown[:, None]
    return weight
