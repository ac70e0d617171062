"""Hand detections of a fit: reliable detections, positions of the knuckles, flexion of the fingers.

Hand landmarks err by 3 to 5 mm, so they give position and orientation of the hand in every frame. The flexion of a
finger in one frame errs by 0.25 rad, so one value for each finger is estimated from all frames.
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
"""Minimum handedness score: hands that are more likely the other one are not used."""

MAX_WRIST_DISTANCE_M = 0.05
"""Maximum distance between the wrists of the pose model and of the hand model."""

MIN_HAND_FRAMES = 8
"""Minimum number of frames with a hand for estimating the flexion of its fingers; otherwise they are relaxed."""

MAX_CURL_RAD = 1.2
_KNUCKLES = (5, 9, 13, 17)
"""First of the four points of each of `FINGERS`; point 0 is the wrist."""


def filter_hand_detections(hands: HandLandmarks, landmarks_px: Float[np.ndarray, "n 33 2"]) -> HandLandmarks:
    """Return the hands with score 0 where the handedness is doubtful or the wrist is far from that of the pose."""
    distance_px = np.linalg.norm(hands.landmarks_px[:, :, 0] - landmarks_px[:, WRISTS], axis=-1)
    near = distance_px < MAX_WRIST_DISTANCE_M * image_scale_px_per_m(hands.landmarks_px, hands.landmarks_m)
    return replace(
        hands, handedness_score=np.where(near & (hands.handedness_score >= MIN_HANDEDNESS), hands.handedness_score, 0.0)
    )


def hand_landmarks(
    hands: HandLandmarks, pose_world_m: Float[np.ndarray, "n 33 3"]
) -> tuple[Float[np.ndarray, "n k 2"], Float[np.ndarray, "n k 3"], Float[np.ndarray, "n k"]]:
    """Return the hand landmarks used by the fit (`HAND_LANDMARKS`, left and right alternating).

    pose_world_m: pose landmarks relative to the hips.

    Returns pixels, positions relative to the hips (m; wrist of the pose plus offsets of the hand model) and confidence.
    """
    points_px, points_m = hands.landmarks_px[:, :, HAND_LANDMARKS], hands.landmarks_m[:, :, HAND_LANDMARKS]
    positions_m = pose_world_m[:, WRISTS, None] + points_m - hands.landmarks_m[:, :, :1]
    pixels, places = (
        values.swapaxes(1, 2).reshape(len(values), 2 * len(HAND_LANDMARKS), -1) for values in (points_px, positions_m)
    )
    return pixels, places, np.tile(hands.handedness_score, len(HAND_LANDMARKS))


def finger_curls_rad(body: ParametricBody, hands: HandLandmarks) -> Float[np.ndarray, "2 4"]:
    """Return the flexion of the left and right `FINGERS` relative to the A-pose (rad), median over frames.

    Fingers of a rarely detected hand, and all of a body without fingers, are relaxed.
    """
    curls = relaxed_curls_rad()
    if "LeftHandPinky3" not in body.joint_names:
        return curls
    for side in range(2):
        detected = hands.landmarks_m[hands.handedness_score[:, side] > 0.0, side]
        if len(detected) >= MIN_HAND_FRAMES:
            curl_rad = finger_flexion_rad(detected, side) - finger_flexion_rad(rest_hand_points_m(body, side), side)
            curls[side] = np.median(curl_rad.mean(-1), axis=0).clip(0.0, MAX_CURL_RAD)
    return curls


def finger_flexion_rad(hand_m: Float[np.ndarray, "*n 21 3"], side: int) -> Float[np.ndarray, "*n 4 3"]:
    """Return the angles at the three joints of the four fingers (rad) about the knuckle line; positive closes the fist.

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
    """Return wrist and fingers in the A-pose of the default shape (m); nan for the thumb.

    The last bone of a finger repeats the one before it.
    """
    joints_m = body.rest_pose(body.shape_defaults)[1].double().numpy()
    name = ("LeftHand", "RightHand")[side]
    points = np.full((N_HAND_LANDMARKS, 3), np.nan)
    points[0] = joints_m[body.joint_names.index(name)]
    for finger, knuckle in zip(FINGERS, _KNUCKLES, strict=True):
        rows = [body.joint_names.index(f"{name}{finger}{bone}") for bone in (1, 2, 3)]
        points[knuckle : knuckle + 3] = joints_m[rows]
        points[knuckle + 3] = 2.0 * points[knuckle + 2] - points[knuckle + 1]
    return points
