"""What hands tell a fit: which sightings can be relied on, where knuckles are, how far fingers are bent.

Points of a hand are off by 3 to 5 mm, so they say where it is and how the wrist is turned in every frame. The bend of a
finger in one frame is off by 0.25 rad, so one number a finger is taken from all frames.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from pipeline.body.body import ParametricBody
from pipeline.body.fit.landmark_regressor import HAND_LANDMARKS
from pipeline.body.fit.linear_body import FINGERS, relaxed_curls_rad
from pipeline.capture.hand_detector import N_HAND_LANDMARKS, HandLandmarks, image_scale_px_per_m
from pipeline.capture.landmarks import WRISTS

MIN_HANDEDNESS = 0.5
"""A hand that is more likely the other one is not used. Seen edge-on, no model can tell."""

MAX_WRIST_DISTANCE_M = 0.05
"""How far apart the wrists of the pose model and of the hand model may lie."""

MIN_HAND_FRAMES = 8
"""Fingers keep their relaxed grip unless their hand was seen in so many frames."""

MAX_CURL_RAD = 1.2
_KNUCKLES = (5, 9, 13, 17)
"""First of the four points of each of `FINGERS`; point 0 is the wrist."""


def filter_hand_detections(hands: HandLandmarks, landmarks_px: Float[np.ndarray, "n 33 2"]) -> HandLandmarks:
    """The hands with `handedness_score` 0 also where a hand is not to be relied on: the other one, or far from the
    wrist.
    """
    distance_px = np.linalg.norm(hands.landmarks_px[:, :, 0] - landmarks_px[:, WRISTS], axis=-1)
    near = distance_px < MAX_WRIST_DISTANCE_M * image_scale_px_per_m(hands.landmarks_px, hands.landmarks_m)
    return replace(
        hands, handedness_score=np.where(near & (hands.handedness_score >= MIN_HANDEDNESS), hands.handedness_score, 0.0)
    )


def hand_landmarks(
    hands: HandLandmarks, pose_world_m: Float[np.ndarray, "n 33 3"]
) -> tuple[Float[np.ndarray, "n k 2"], Float[np.ndarray, "n k 3"], Float[np.ndarray, "n k"]]:
    """Pixels, places about the hips (m, the pose's wrist plus what the hand model says) and trust of the points that
    follow the pose's landmarks in a fit, in their order."""
    points_px, points_m = hands.landmarks_px[:, :, HAND_LANDMARKS], hands.landmarks_m[:, :, HAND_LANDMARKS]
    positions_m = pose_world_m[:, WRISTS, None] + points_m - hands.landmarks_m[:, :, :1]
    pixels, places = (
        values.swapaxes(1, 2).reshape(len(values), 2 * len(HAND_LANDMARKS), -1) for values in (points_px, positions_m)
    )
    return pixels, places, np.tile(hands.handedness_score, len(HAND_LANDMARKS))


def finger_curls_rad(body: ParametricBody, hands: HandLandmarks) -> Float[np.ndarray, "2 4"]:
    """How much further than in the A-pose each finger joint is bent, of left and right `FINGERS`: median over frames.

    A hand that is hardly ever seen, and a body without fingers, keep the relaxed grip.
    """
    curls = relaxed_curls_rad()
    if "LeftHandPinky3" not in body.joint_names:
        return curls
    for side in range(2):
        seen = hands.landmarks_m[hands.handedness_score[:, side] > 0.0, side]
        if len(seen) >= MIN_HAND_FRAMES:
            beyond = finger_flexion_rad(seen, side) - finger_flexion_rad(rest_hand_points_m(body, side), side)
            curls[side] = np.median(beyond.mean(-1), axis=0).clip(0.0, MAX_CURL_RAD)
    return curls


def finger_flexion_rad(hand_m: Float[np.ndarray, "*n 21 3"], side: int) -> Float[np.ndarray, "*n 4 3"]:
    """Angles at the three joints of the four fingers, about the line through the knuckles; positive closes the fist.

    hand_m: 21 points in any rigid frame. side: 0 left, 1 right.
    """
    across = hand_m[..., 17, :] - hand_m[..., 5, :] if side == 0 else hand_m[..., 5, :] - hand_m[..., 17, :]
    axis = (across / np.linalg.norm(across, axis=-1, keepdims=True))[..., None, None, :]
    chain = np.stack([hand_m[..., [0, *range(k, k + 4)], :] for k in _KNUCKLES], axis=-3)
    bones = np.diff(chain, axis=-2)
    bones = bones - (bones * axis).sum(-1, keepdims=True) * axis
    first, second = bones[..., :-1, :], bones[..., 1:, :]
    return np.arctan2((np.cross(first, second) * axis).sum(-1), (first * second).sum(-1))


def rest_hand_points_m(body: ParametricBody, side: int) -> Float[np.ndarray, "21 3"]:
    """Where wrist and fingers are in the A-pose of the default shape; nan for the thumb. Last bones go on straight."""
    joints_m = body.rest(body.shape_defaults)[1].double().numpy()
    name = ("LeftHand", "RightHand")[side]
    points = np.full((N_HAND_LANDMARKS, 3), np.nan)
    points[0] = joints_m[body.joint_names.index(name)]
    for finger, knuckle in zip(FINGERS, _KNUCKLES, strict=True):
        rows = [body.joint_names.index(f"{name}{finger}{bone}") for bone in (1, 2, 3)]
        points[knuckle : knuckle + 3] = joints_m[rows]
        points[knuckle + 3] = 2.0 * points[knuckle + 2] - points[knuckle + 1]
    return points
