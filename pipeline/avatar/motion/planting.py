"""Feet that stand still: hips, pelvis and feet of a whole motion in one least-squares problem.

A clip of a person of other proportions slides, although every bone has the recorded direction: hip joints that are
farther apart swing farther as the pelvis turns, and thighs and shins have another ratio. Unknown in each frame are a
translation of the hips, a rotation of the pelvis, and a translation of each foot. The directions of thighs and shins
change as little as possible, the corrections are smooth, and a standing sole stays in a disc on the floor. The rotation
of feet and trunk does not change.

Gauss-Newton on the directions; inside, the discs and the floor by the alternating direction method of multipliers
(Boyd et al. 2011, section 5.2). Unknowns of a frame are coupled to those of the two frames before and after it, so the
normal equations are banded.

Notation: n frames; s sides (left, right); 12 unknowns of a frame: hips (3), pelvis (3), left foot (3), right foot (3).
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.ndimage import gaussian_filter1d, maximum_filter1d
from scipy.spatial.transform import Rotation

from pipeline.avatar.motion.feet import joint_positions_m
from pipeline.body.body import Body, Motion, canonical_to_world
from pipeline.body.fit.ground_contact import SOLE_JOINTS
from pipeline.capture.frame_selection import runs_of
from pipeline.geometry.rotation import rotation_between
from pipeline.geometry.skinning import local_quaternions

SLIDE_RADIUS_M, MAX_FLOAT_M = 0.0045, 0.005
"""Radius of the disc in which a standing sole stays, so that it slides less than 10 mm, and its greatest height."""

_SLIDE_COST_RAD_M = 5.0
"""Cost of a sole's distance from its place, in rad of a bone's direction: nothing slides where the hips can follow."""

_PELVIS_COST = 0.6
"""Cost of a turn of the pelvis, as a share of that of a bone of a leg."""

_ACCELERATION_COST = 0.001
"""Cost of the acceleration of a correction, rad for 1 m/s^2."""

_PELVIS_RADIUS_M = 0.3
"""Radius at which a rotation of the pelvis is a translation, for the acceleration."""

_REACH_COST_RAD = 20.0
"""Cost of a leg longer than it can be, for a stretch of its own length."""

MAX_LEG_STRETCH = 0.999
"""Longest distance of hip and ankle, as a fraction of the length of the leg, unless it is straighter in the clip."""

_STRAIGHT_SINE = 0.01
"""Sine of the angle between thigh and leg below which the plane of the knee is taken from the axes of the thigh."""

_STEP_M = 0.002
"""Of the central differences; smaller than it, the bend of a straight leg is not smooth."""

_OUTER_STEPS, _INNER_STEPS, _PENALTY_RAD_M, _DAMPING = 5, 60, 30.0, 1e-2
_SINK_SMOOTHING_S = 0.06
_UNKNOWNS, _BAND = 12, 36
_HIPS, _PELVIS, _FEET = slice(0, 3), slice(3, 6), slice(6, 12)
_SIDES = ("Left", "Right")


@dataclass(frozen=True)
class _Legs:
    """Both legs of a motion before the correction, in the world.

    Attributes:
        thigh_m: hip to knee. shin_m: knee to ankle. hip_m: hip joint relative to the root.
        lateral: axis of the thigh, whose cross product with a straight leg is the front of the knee.
    """

    thigh_m: Float[np.ndarray, "n 2 3"]
    shin_m: Float[np.ndarray, "n 2 3"]
    hip_m: Float[np.ndarray, "n 2 3"]
    lateral: Float[np.ndarray, "n 2 3"]

    def reach_m(self) -> Float[np.ndarray, "n 2"]:
        """Return the longest distance of hip and ankle."""
        length_m = np.linalg.norm(self.thigh_m, axis=-1) + np.linalg.norm(self.shin_m, axis=-1)
        return np.maximum(MAX_LEG_STRETCH * length_m, np.linalg.norm(self.thigh_m + self.shin_m, axis=-1))

    def ankle_shift_m(self, unknowns: Float[np.ndarray, "n 12"]) -> Float[np.ndarray, "n 2 3"]:
        """Return the movement of the ankles relative to their hip joints."""
        turned_m = np.einsum("nab,nsb->nsa", Rotation.from_rotvec(unknowns[:, _PELVIS]).as_matrix(), self.hip_m)
        return unknowns[:, _FEET].reshape(-1, 2, 3) - unknowns[:, None, _HIPS] - (turned_m - self.hip_m)

    def bent(self, shift_m: Float[np.ndarray, "n 2 3"]) -> Float[np.ndarray, "n 2 6"]:
        """Return the directions of thigh and shin after a movement of the ankle.

        The knee stays in its plane; that of a straight leg is perpendicular to the lateral axis of the thigh.
        """
        leg_m = self.thigh_m + self.shin_m + shift_m
        a, b = (np.linalg.norm(bone, axis=-1, keepdims=True) for bone in (self.thigh_m, self.shin_m))
        distance = np.linalg.norm(leg_m, axis=-1, keepdims=True)
        along = leg_m / distance
        reach = np.clip(distance, np.abs(a - b) / MAX_LEG_STRETCH, self.reach_m()[..., None])
        to_new_leg = rotation_between(torch.from_numpy(self.thigh_m + self.shin_m), torch.from_numpy(leg_m)).numpy()
        thigh = (to_new_leg @ (self.thigh_m / a)[..., None])[..., 0]
        cosine = np.clip((a**2 + reach**2 - b**2) / (2.0 * a * reach), -1.0, 1.0)
        hinge_front = np.cross(along, (to_new_leg @ self.lateral[..., None])[..., 0])
        old_bend = thigh - _dot(thigh, along) * along
        new_thigh = cosine * along + _bend_to(old_bend, hinge_front, np.sqrt(1.0 - cosine**2))
        return np.concatenate([new_thigh, (reach * along - a * new_thigh) / b], axis=-1)

    def residuals(self, shift_m: Float[np.ndarray, "n 2 3"]) -> Float[np.ndarray, "n 2 7"]:
        """Return thigh, shin, and the cost of a leg that is too long."""
        length_m = np.linalg.norm(self.thigh_m + self.shin_m + shift_m, axis=-1)
        too_long = np.maximum(length_m / self.reach_m() - 1.0, 0.0)
        return np.concatenate([self.bent(shift_m), _REACH_COST_RAD * too_long[..., None]], axis=-1)


@dataclass(frozen=True)
class _Stand:
    """Where feet must be.

    Attributes:
        track_m: of the held sole of each foot, any sole where none is held; horizontally, a sole that is held after the
            other one continues its track.
        contacts: side, first frame and end (exclusive) of each time in which a sole is held.
        held: frames of those times.
        height_m: of the held sole. lowest_m: least upward movement of a foot, so that none of its soles is below the
            floor.
    """

    track_m: Float[np.ndarray, "n 2 3"]
    contacts: list[tuple[int, int, int]]
    held: Bool[np.ndarray, "n 2"]
    height_m: Float[np.ndarray, "n 2"]
    lowest_m: Float[np.ndarray, "n 2"]

    def nearest(self, shift_m: Float[np.ndarray, "n 2 3"], slide_weight: float) -> Float[np.ndarray, "n 2 3"]:
        """Return the allowed movement of the feet nearest to a given one.

        slide_weight: 0 for the nearest, up to 1 to draw soles to their places: the proximal operator of the cost.
        """
        moved, place_m = shift_m.copy(), self.track_m + shift_m
        for side, first, end in self.contacts:
            flat_m = place_m[first:end, side][:, [0, 2]]
            middle_m = 0.5 * (flat_m.min(axis=0) + flat_m.max(axis=0))
            offset_m = (1.0 - slide_weight) * (flat_m - middle_m)
            distance_m = np.linalg.norm(offset_m, axis=1, keepdims=True)
            offset_m *= np.minimum(1.0, SLIDE_RADIUS_M / np.maximum(distance_m, 1e-12))
            moved[first:end, side, 0::2] = middle_m + offset_m - self.track_m[first:end, side, 0::2]
        standing_m = self.height_m - self.track_m[..., 1]
        height_m = np.minimum((1.0 - slide_weight) * (moved[..., 1] - standing_m), MAX_FLOAT_M) + standing_m
        moved[..., 1] = np.maximum(np.where(self.held, height_m, moved[..., 1]), self.lowest_m)
        return moved


def plant_feet(body: Body, motion: Motion, contact: Bool[np.ndarray, "n 4"], floor_y_m: float) -> Motion:
    """Return the motion with soles that stay where they stand, within millimetres, and no sole below the floor.

    While the ball of a foot stands it is held, otherwise the ankle.

    Args:
        motion: frames at a constant rate.
        contact: result of `find_contacts`, for the same frames.
        floor_y_m: height of the floor.

    Raises:
        ValueError: the skeleton has no legs.
    """
    positions_m = joint_positions_m(body, motion)
    world = canonical_to_world(body, motion)[..., :3, :3].numpy().astype(np.float64)
    step_s = float(np.median(np.diff(motion.time_s))) if len(motion.time_s) > 1 else 1.0
    joints = np.array([[body.joint(side + part) for part in ("UpLeg", "Leg", "Foot")] for side in _SIDES]).T
    hip_m, knee_m, ankle_m = (positions_m[:, row] for row in joints)
    legs = _Legs(knee_m - hip_m, ankle_m - knee_m, hip_m - positions_m[:, :1], world[..., 0][:, joints[0]])
    stand = _standing(body, positions_m, contact, floor_y_m)
    unknowns = _solve(legs, stand, step_s)
    shift_m = legs.ankle_shift_m(unknowns)
    sink_m = _sink_m(legs, shift_m, stand.held, _SINK_SMOOTHING_S / step_s)
    shift_m[..., 1] += sink_m[:, None]
    bones = legs.bent(shift_m).reshape(len(world), 2, 2, 3)
    for row, (joint, old_m) in enumerate(zip(joints[:2], (legs.thigh_m, legs.shin_m), strict=True)):
        turn = rotation_between(torch.from_numpy(old_m), torch.from_numpy(np.ascontiguousarray(bones[:, :, row])))
        world[:, joint] = turn.numpy() @ world[:, joint]
    world[:, 0] = Rotation.from_rotvec(unknowns[:, _PELVIS]).as_matrix() @ world[:, 0]
    root_m = positions_m[:, 0] + unknowns[:, _HIPS]
    root_m[:, 1] -= sink_m
    return motion.with_pose(local_quaternions(world, body.parents), root_m)


def _bend_to(
    bend: Float[np.ndarray, "n 2 3"], hinge_front: Float[np.ndarray, "n 2 3"], sine: Float[np.ndarray, "n 2 1"]
) -> Float[np.ndarray, "n 2 3"]:
    """Return the part of the thigh's direction perpendicular to the leg, with a new length: itself if that is its own.

    A longer one grows in its plane; where the leg is straight, towards the front of the knee, because the plane of a
    straight leg is noise. Some recorded knees bend backwards by some degrees: they stay so.
    """
    straightness = np.clip(1.0 - np.sqrt(_dot(bend, bend)) / _STRAIGHT_SINE, 0.0, 1.0)
    bend = bend - straightness * np.minimum(_dot(bend, hinge_front), 0.0) * hinge_front
    length = np.sqrt(_dot(bend, bend))
    front = bend + _STRAIGHT_SINE * straightness * hinge_front
    front /= np.sqrt(_dot(front, front))
    ahead = _dot(bend, front)
    more = np.sqrt(np.maximum(ahead**2 + sine**2 - length**2, 0.0)) - ahead
    shorter = bend * (sine / np.maximum(length, 1e-12))
    return np.where(sine < length, shorter, bend + more * front)


def _dot(a: Float[np.ndarray, "n 2 3"], b: Float[np.ndarray, "n 2 3"]) -> Float[np.ndarray, "n 2 1"]:
    return np.asarray((a * b).sum(axis=-1, keepdims=True))


def _standing(
    body: Body, positions_m: Float[np.ndarray, "n j 3"], contact: Bool[np.ndarray, "n 4"], floor_y_m: float
) -> _Stand:
    soles: Int[np.ndarray, "2 2"] = np.array([body.joint(name) for name in SOLE_JOINTS]).reshape(2, 2)
    standing_m = floor_y_m + body.joints_m[soles, 1].astype(np.float64)
    is_held = contact.reshape(-1, 2, 2)
    sole = np.where(is_held[..., 1], 1, np.where(is_held[..., 0], 0, -1))
    sides, frames = np.arange(2), np.arange(len(sole))
    track_m = positions_m[frames[:, None], soles[sides, np.maximum(sole, 0)]]
    contacts = []
    for side in range(2):
        contacts += [(side, first, end) for first, end in runs_of(sole[:, side] >= 0)]
        edges = np.r_[np.flatnonzero(np.diff(sole[:, side])) + 1, len(sole)].tolist()
        for first, end in zip(edges[:-1], edges[1:], strict=True):
            if sole[first - 1, side] >= 0 and sole[first, side] >= 0:
                before_m = positions_m[first - 1, soles[side, sole[first, side]]]
                track_m[first:end, side, 0::2] += (track_m[first - 1, side] - before_m)[0::2]
    lowest_m = (standing_m - positions_m[:, soles, 1]).max(axis=2)
    return _Stand(track_m, contacts, sole >= 0, standing_m[sides, np.maximum(sole, 0)], lowest_m)


def _solve(legs: _Legs, stand: _Stand, step_s: float) -> Float[np.ndarray, "n 12"]:
    """Return the unknowns; those of the feet are allowed exactly."""
    count = len(stand.held)
    unknowns = np.zeros((count, _UNKNOWNS))
    bones = legs.bent(np.zeros((count, 2, 3)))
    held = np.stack([stand.held, np.ones_like(stand.held), stand.held], axis=-1).reshape(count, 6)
    penalty = np.zeros((count, _UNKNOWNS))
    penalty[:, _FEET] = np.where(held, _PENALTY_RAD_M**2, 0.0)  # the floor is below every foot
    slide_weight = _SLIDE_COST_RAD_M**2 / (_SLIDE_COST_RAD_M**2 + _PENALTY_RAD_M**2)
    allowed = stand.nearest(np.zeros((count, 2, 3)), 0.0)
    excess = np.zeros_like(allowed)
    for _ in range(_OUTER_STEPS):
        hessian, gradient = _linearised(legs, bones, unknowns)
        factor = cholesky_banded(_banded(hessian, penalty, step_s), lower=True)
        for _ in range(_INNER_STEPS):
            pull = -gradient
            pull[:, _FEET] += penalty[:, _FEET] * (allowed - excess).reshape(count, 6)
            unknowns = cho_solve_banded((factor, True), pull.ravel()).reshape(count, _UNKNOWNS)
            feet_m = unknowns[:, _FEET].reshape(count, 2, 3)
            allowed = stand.nearest(feet_m + excess, slide_weight)
            excess = np.where(held.reshape(count, 2, 3), excess + feet_m - allowed, 0.0)
    unknowns[:, _FEET] = stand.nearest(unknowns[:, _FEET].reshape(count, 2, 3), 0.0).reshape(count, 6)
    return unknowns


def _linearised(
    legs: _Legs, bones: Float[np.ndarray, "n 2 6"], unknowns: Float[np.ndarray, "n 12"]
) -> tuple[Float[np.ndarray, "n 12 12"], Float[np.ndarray, "n 12"]]:
    """Return half the Hessian of the costs of a frame, and half the gradient at 0, about the current unknowns."""
    shift_m = legs.ankle_shift_m(unknowns)
    error = legs.residuals(shift_m)
    error[..., :6] -= bones
    steps = [_STEP_M * axis for axis in np.eye(3)]
    columns = [(legs.residuals(shift_m + step) - legs.residuals(shift_m - step)) / (2.0 * _STEP_M) for step in steps]
    by_shift = np.stack(columns, axis=-1)
    by_unknown = np.zeros((len(unknowns), 2, 3, _UNKNOWNS))
    by_unknown[..., _HIPS] = -np.eye(3)
    turned_m = np.einsum("nab,nsb->nsa", Rotation.from_rotvec(unknowns[:, _PELVIS]).as_matrix(), legs.hip_m)
    by_unknown[..., _PELVIS] = np.cross(turned_m[..., None, :], np.eye(3)).swapaxes(-1, -2)
    for side in range(2):
        by_unknown[:, side, :, 6 + 3 * side : 9 + 3 * side] = np.eye(3)
    jacobian = by_shift @ by_unknown
    offset = error - np.einsum("nsri,ni->nsr", jacobian, unknowns)
    hessian = np.einsum("nsri,nsrj->nij", jacobian, jacobian) + _DAMPING**2 * np.eye(_UNKNOWNS)
    hessian[:, range(3, 6), range(3, 6)] += _PELVIS_COST**2
    return hessian, np.einsum("nsri,nsr->ni", jacobian, offset)


def _banded(
    hessian: Float[np.ndarray, "n 12 12"], penalty: Float[np.ndarray, "n 12"], step_s: float
) -> Float[np.ndarray, "36 m"]:
    """Return the lower band of the normal equations: frames, penalties and accelerations."""
    count = len(hessian)
    band = np.zeros((_BAND, count, _UNKNOWNS))
    for row, column in zip(*np.tril_indices(_UNKNOWNS), strict=True):
        band[row - column, :, column] = hessian[:, row, column]
    band[0] += penalty
    scale = np.ones(_UNKNOWNS)
    scale[_PELVIS] = _PELVIS_RADIUS_M
    weight = (_ACCELERATION_COST * scale / step_s**2) ** 2
    inner = max(count - 2, 0)
    for first, first_factor in enumerate((1.0, -2.0, 1.0)):
        for second, second_factor in enumerate((1.0, -2.0, 1.0)):
            if second >= first:
                band[(second - first) * _UNKNOWNS, first : first + inner] += first_factor * second_factor * weight
    return band.reshape(_BAND, count * _UNKNOWNS)


def _sink_m(
    legs: _Legs, shift_m: Float[np.ndarray, "n 2 3"], held: Bool[np.ndarray, "n 2"], sigma: float
) -> Float[np.ndarray, "n"]:
    """Return how far the hips must sink so that the legs reach the held feet, smoothed over `sigma` frames."""
    leg_m = legs.thigh_m + legs.shin_m + shift_m
    horizontal_m = np.linalg.norm(leg_m[..., [0, 2]], axis=-1)
    needed_m = -leg_m[..., 1] - np.sqrt(np.maximum(legs.reach_m() ** 2 - horizontal_m**2, 0.0))
    sink_m = np.where(held, np.maximum(needed_m, 0.0), 0.0).max(axis=1)
    return gaussian_filter1d(maximum_filter1d(sink_m, 2 * int(np.ceil(2.0 * sigma)) + 1), sigma, truncate=2.0)
