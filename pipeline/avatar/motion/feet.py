"""Feet on the floor: where they are and where they stand in a motion.

Notation: n frames; 4 soles: left ankle and ball of the foot, right ankle and ball (`SOLE_JOINTS`).
"""

import numpy as np
import torch
from jaxtyping import Bool, Float

from pipeline.body.body import Body, Motion, canonical_to_world, posed_joints_m
from pipeline.body.fit.ground_contact import SOLE_JOINTS, compute_speed_m_s
from pipeline.capture.frame_selection import runs_of

CONTACT_HEIGHT_M, CONTACT_SPEED_M_S = 0.04, 0.15
"""Height above the lowest (5th percentile of the lower one of both sides) and speed below which a sole stands."""

MIN_CONTACT_S = 0.1
"""Shorter contacts are ignored, shorter gaps between contacts are closed."""


def joint_positions_m(body: Body, motion: Motion) -> Float[np.ndarray, "n j 3"]:
    """Return the world positions of all joints."""
    return posed_joints_m(body, canonical_to_world(body, motion))


def sole_positions_m(body: Body, motion: Motion) -> Float[np.ndarray, "n 4 3"]:
    """Return the world positions of ankles and balls of the feet."""
    return joint_positions_m(body, motion)[:, [body.joint(name) for name in SOLE_JOINTS]]


def lowest_foot_offset_m(body: Body, motion: Motion) -> Float[np.ndarray, "n"]:
    """Return the height of the lowest foot joint (ankle, ball of the foot) relative to its height in the A-pose."""
    rest_height_m = body.joints_m[[body.joint(name) for name in SOLE_JOINTS], 1]
    return (sole_positions_m(body, motion)[..., 1] - rest_height_m).min(axis=1)


def snap_feet_to_floor(body: Body, motion: Motion, floor_y_m: float) -> Motion:
    """Translate each frame vertically so that the lowest foot joint has its A-pose height above the floor."""
    root = motion.root_translation_m.copy()
    root[:, 1] += floor_y_m - lowest_foot_offset_m(body, motion)
    return motion.with_pose(motion.rotations_wxyz, root)


def find_contacts(soles_m: Float[np.ndarray, "n 4 3"], time_s: Float[np.ndarray, "n"]) -> Bool[np.ndarray, "n 4"]:
    """Return where each sole stands: it is low and slow."""
    speed_m_s = compute_speed_m_s(torch.from_numpy(soles_m), torch.from_numpy(time_s)).numpy()
    lower_side_m = soles_m[..., 1].reshape(-1, 2, 2).min(axis=1)
    height_m = soles_m[..., 1] - np.tile(np.percentile(lower_side_m, 5.0, axis=0), 2)
    contact = (speed_m_s < CONTACT_SPEED_M_S) & (height_m < CONTACT_HEIGHT_M)
    for sole in range(contact.shape[1]):
        for is_contact in (False, True):
            for first, end in runs_of(contact[:, sole] == is_contact):
                lasts_s = time_s[min(end, len(time_s) - 1)] - time_s[first]
                if lasts_s < MIN_CONTACT_S and first > 0 and end < len(time_s):
                    contact[first:end, sole] = not is_contact
    return contact
