"""Feet on the floor: where they stand in a motion, and hips and legs that hold them there.

The hips follow the standing feet, so that legs turn little; legs bend for what remains, as where both feet stand. The
rotation of feet and trunk does not change. The hips sink where a leg would have to be longer than it is.

Notation: n frames; 4 soles: left ankle and ball of the foot, right ankle and ball (`SOLE_JOINTS`).
"""

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter1d, maximum_filter1d

from pipeline.body.body import Body, Motion, canonical_to_world
from pipeline.body.fit.ground_contact import SOLE_JOINTS, compute_speed_m_s
from pipeline.geometry.rotation import rotation_between
from pipeline.geometry.skinning import local_quaternions

CONTACT_HEIGHT_M, CONTACT_SPEED_M_S = 0.04, 0.15
"""Height above the lowest (5th percentile of the lower one of both sides) and speed below which a sole stands."""

MIN_CONTACT_S = 0.1
"""Shorter contacts are ignored, shorter gaps between contacts are closed."""

MAX_LEG_STRETCH = 0.999
"""Longest distance of hip and ankle, as a fraction of the length of the leg."""

_SMOOTHING_S = 0.06
"""Standard deviation of the smoothing of heights and of the shares of both feet in the shift of the hips."""

_STRAIGHT_SINE = 0.05
"""Sine of the angle between thigh and leg below which the plane of the knee is taken from the axes of the thigh."""

_FADE_S = 0.5
"""Time in which a correction fades after and before a contact; between contacts that follow sooner it is blended."""

_MIN_SHARE = 1e-3
_SIDES = ("Left", "Right")


def joint_positions_m(body: Body, motion: Motion) -> Float[np.ndarray, "n j 3"]:
    """Return the world positions of all joints."""
    transforms = canonical_to_world(body, motion).numpy().astype(np.float64)
    return (transforms[..., :3, :3] @ body.joints_m[:, :, None])[..., 0] + transforms[..., :3, 3]


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
            for first, end in _runs(contact[:, sole] == is_contact):
                lasts_s = time_s[min(end, len(time_s) - 1)] - time_s[first]
                if lasts_s < MIN_CONTACT_S and first > 0 and end < len(time_s):
                    contact[first:end, sole] = not is_contact
    return contact


def plant_feet(body: Body, motion: Motion, contact: Bool[np.ndarray, "n 4"], floor_y_m: float) -> Motion:
    """Return the motion with soles that do not slide where they stand, and no sole below the floor.

    While the ball of a foot stands it is held, otherwise the ankle. Each stands at its mean position; a sole that
    follows without a gap stands where it then is. Heights are corrected by the hips alone. Before and after contacts
    the correction fades.

    Args:
        contact: result of `find_contacts`, for the same frames.
        floor_y_m: height of the floor.

    Raises:
        ValueError: the skeleton has no legs.
    """
    positions = joint_positions_m(body, motion)
    world = canonical_to_world(body, motion)[..., :3, :3].numpy().astype(np.float64)
    sigma = _SMOOTHING_S / (float(np.median(np.diff(motion.time_s))) if len(motion.time_s) > 1 else 1.0)
    soles = np.array([body.joint(name) for name in SOLE_JOINTS]).reshape(2, 2)
    standing_m = floor_y_m + body.joints_m[soles, 1]
    is_held = contact.reshape(-1, 2, 2)
    shift_m = np.stack(
        [_foot_shift_m(positions[:, soles[k]], is_held[:, k], standing_m[k], motion.time_s) for k in range(2)]
    )
    shift_m[..., 1] = gaussian_filter1d(shift_m[..., 1], sigma, axis=1)
    share = gaussian_filter1d(is_held.any(axis=2).astype(float), sigma, axis=0).T[..., None] + _MIN_SHARE
    hips_shift_m = (share * shift_m).sum(axis=0) / share.sum(axis=0)
    shift_m -= hips_shift_m
    shift_m[..., 1] = 0.0  # a leg that is almost straight bends by ten degrees for a centimetre
    positions += hips_shift_m[:, None]
    for side in range(2):
        below_m = (standing_m[side] - positions[:, soles[side], 1]).max(axis=1)
        shift_m[side, :, 1] = np.maximum(shift_m[side, :, 1], below_m)
    sink_m = _sink_m(body, positions, shift_m, is_held.any(axis=2), sigma)
    positions[..., 1] -= sink_m[:, None]
    shift_m[..., 1] += sink_m
    for side, name in enumerate(_SIDES):
        _move_ankle(body, name, positions, world, shift_m[side])
    return motion.with_pose(local_quaternions(world, body.parents), positions[:, 0])


def _foot_shift_m(
    soles_m: Float[np.ndarray, "n 2 3"],
    contact: Bool[np.ndarray, "n 2"],
    standing_m: Float[np.ndarray, "2"],
    time_s: Float[np.ndarray, "n"],
) -> Float[np.ndarray, "n 3"]:
    """Return the translation of a foot that holds its standing sole; 0 in a motion without contacts."""
    held = np.where(contact[:, 1], 1, np.where(contact[:, 0], 0, -1))
    shift_m, known = np.zeros((len(held), 3)), held >= 0
    edges = np.r_[0, np.flatnonzero(np.diff(held)) + 1, len(held)]
    for first, end in zip(edges[:-1], edges[1:], strict=True):
        sole = held[first]
        if sole < 0:
            continue
        track_m = soles_m[first:end, sole]
        target_m = track_m.mean(axis=0)
        if first > 0 and held[first - 1] >= 0:
            target_m = soles_m[first - 1, sole] + shift_m[first - 1]
        target_m[1] = standing_m[sole]
        shift_m[first:end] = target_m - track_m
    for first, end in _runs(~known):
        for edge, time_from_edge_s in (
            (first - 1, time_s[first:end] - time_s[max(first - 1, 0)]),
            (end, time_s[min(end, len(time_s) - 1)] - time_s[first:end]),
        ):
            if 0 <= edge < len(held):
                fade_s = min(_FADE_S, time_s[min(end, len(time_s) - 1)] - time_s[max(first - 1, 0)])
                left = np.clip(1.0 - time_from_edge_s / fade_s, 0.0, 1.0)[:, None]
                shift_m[first:end] += left**2 * (3.0 - 2.0 * left) * shift_m[edge]
    return shift_m


def _leg_joints(body: Body, side: str) -> tuple[int, int, int]:
    hip, knee, ankle = (body.joint(side + part) for part in ("UpLeg", "Leg", "Foot"))
    return hip, knee, ankle


def _sink_m(
    body: Body,
    positions_m: Float[np.ndarray, "n j 3"],
    shift_m: Float[np.ndarray, "2 n 3"],
    is_held: Bool[np.ndarray, "n 2"],
    sigma: float,
) -> Float[np.ndarray, "n"]:
    """Return how far the hips must sink so that the legs reach the held feet, smoothed over `sigma` frames."""
    sink_m = np.zeros(len(positions_m))
    for side, name in enumerate(_SIDES):
        hip, knee, ankle = _leg_joints(body, name)
        reach_m = MAX_LEG_STRETCH * sum(_length(positions_m, a, b) for a, b in ((hip, knee), (knee, ankle)))
        leg_m = positions_m[:, ankle] + shift_m[side] - positions_m[:, hip]
        horizontal = np.linalg.norm(leg_m[:, [0, 2]], axis=1)
        needed = -leg_m[:, 1] - np.sqrt(np.maximum(reach_m**2 - horizontal**2, 0.0))
        sink_m = np.maximum(sink_m, np.where(is_held[:, side], needed, 0.0))
    return gaussian_filter1d(maximum_filter1d(sink_m, 2 * int(np.ceil(2.0 * sigma)) + 1), sigma, truncate=2.0)


def _length(positions_m: Float[np.ndarray, "n j 3"], start: int, end: int) -> Float[np.ndarray, "n"]:
    return np.linalg.norm(positions_m[:, end] - positions_m[:, start], axis=1)


def _move_ankle(
    body: Body,
    side: str,
    positions_m: Float[np.ndarray, "n j 3"],
    world: Float[np.ndarray, "n j 3 3"],
    shift_m: Float[np.ndarray, "n 3"],
) -> None:
    """Turn thigh and shin, in place, so that the ankle moves by `shift_m`.

    The knee stays in its plane; that of a straight leg is perpendicular to the lateral axis of the thigh.
    """
    hip, knee, ankle = _leg_joints(body, side)
    thigh_m, shin_m = positions_m[:, knee] - positions_m[:, hip], positions_m[:, ankle] - positions_m[:, knee]
    leg_m = thigh_m + shin_m + shift_m
    a, b = (np.linalg.norm(bone, axis=1, keepdims=True) for bone in (thigh_m, shin_m))
    distance = np.linalg.norm(leg_m, axis=1, keepdims=True)
    along = leg_m / distance
    reach = np.clip(distance, np.abs(a - b) / MAX_LEG_STRETCH, MAX_LEG_STRETCH * (a + b))
    reach = np.where(np.linalg.norm(shift_m, axis=1, keepdims=True) < 1e-9, distance, reach)
    to_new_leg = rotation_between(torch.from_numpy(thigh_m + shin_m), torch.from_numpy(leg_m)).numpy()
    turned_thigh = (to_new_leg @ (thigh_m / a)[..., None])[..., 0]
    bend = turned_thigh - (turned_thigh * along).sum(axis=1, keepdims=True) * along
    hinge_front = np.cross(along, (to_new_leg @ world[:, hip, :, :1])[..., 0])
    straightness = np.clip(1.0 - np.linalg.norm(bend, axis=1, keepdims=True) / _STRAIGHT_SINE, 0.0, 1.0)
    front = bend + _STRAIGHT_SINE * straightness * hinge_front
    front /= np.linalg.norm(front, axis=1, keepdims=True)
    cosine = np.clip((a**2 + reach**2 - b**2) / (2.0 * a * reach), -1.0, 1.0)
    new_thigh = a * (cosine * along + np.sqrt(1.0 - cosine**2) * front)
    for joint, old, new in ((hip, thigh_m, new_thigh), (knee, shin_m, reach * along - new_thigh)):
        world[:, joint] = rotation_between(torch.from_numpy(old), torch.from_numpy(new)).numpy() @ world[:, joint]


def _runs(flags: Bool[np.ndarray, "n"]) -> list[tuple[int, int]]:
    """Return start and end of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return [(int(first), int(end)) for first, end in edges.reshape(-1, 2)]
