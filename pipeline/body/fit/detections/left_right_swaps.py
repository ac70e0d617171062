"""Detection and correction of left-right swaps of the landmark detector.

People do not turn by 180 degrees between two frames, and a limb does not jump to the position of the other one. Both
are decided by dynamic programming over two labels of each frame (as detected, swapped), so that the ends of a run of
swapped frames reveal all of it.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from pipeline.body.fit.initialisation import facing_yaw_rad, has_torso_landmarks, torso_rotations
from pipeline.body.fit.landmark_regressor import (
    POSE_LANDMARK_COUNT,
    SWAP_PAIR_GROUPS,
    mirror_permutation,
)
from pipeline.body.fit.state import Observations

SWAP_COST = 0.25
"""Cost of labelling a frame as swapped; the costs below are relative to it."""

MIN_INTERVAL_S = 0.2
"""Minimum interval that a change is divided by: in shorter ones changes are mostly noise of the detector."""

YAW_CHANGE_COST = 2.0
FREE_YAW_CHANGE_RAD = 0.35
"""Costs of a change of yaw: `YAW_CHANGE_COST` for each radian above `FREE_YAW_CHANGE_RAD` in `MIN_INTERVAL_S`."""

LANDMARK_JUMP_COST = 1.5
"""Cost of a limb that moves by the size of the torso in `MIN_INTERVAL_S`, mean over its landmarks."""

WRONG_SIDE_COST = 1.0
WRONG_SIDE_DISTANCE_M = 0.15
"""Cost of a limb at this distance on the wrong side of the body (left knee to the right of the right one)."""

CAMERA_TO_Y_UP = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
"""From camera axes (y down, z away) to those of `facing_yaw_rad` (y up, z towards the viewer)."""


class LimbPairs(NamedTuple):
    """Left-right pairs of landmark indices of arms or legs.

    swapped: pairs that are swapped together.
    order_pair: the pair whose order is compared with that of `torso_pair`.
    """

    swapped: tuple[tuple[int, ...], ...]
    order_pair: tuple[int, int]
    torso_pair: tuple[int, int]


LIMB_SWAP_PAIRS = {
    "arms": LimbPairs(SWAP_PAIR_GROUPS["arms"], (13, 14), (11, 12)),
    "legs": LimbPairs(SWAP_PAIR_GROUPS["legs"], (25, 26), (23, 24)),
}


def viterbi_two_labels(
    unary: Float[np.ndarray, "n 2"], same: Float[np.ndarray, "k"], other: Float[np.ndarray, "k"]
) -> Bool[np.ndarray, "n"]:
    """Return the cheapest sequence of two labels (Viterbi); True where it has label 1.

    unary: cost of each label in each frame. same, other: cost of keeping and of changing the label between neighbours.
    """
    cost = unary[0]
    back = np.zeros(unary.shape, dtype=np.int64)
    for step in range(1, len(unary)):
        total = cost[:, None] + np.array([[same[step - 1], other[step - 1]], [other[step - 1], same[step - 1]]])
        back[step] = total.argmin(axis=0)
        cost = total.min(axis=0) + unary[step]
    labels = np.zeros(len(unary), dtype=bool)
    label = int(cost.argmin())
    for step in range(len(unary) - 1, -1, -1):
        labels[step] = bool(label)
        label = int(back[step, label])
    return labels


def detect_body_swaps(
    observations: Observations, rest_landmarks_m: Float[torch.Tensor, "l 3"]
) -> Bool[np.ndarray, "n"]:
    """Return the frames in which the detector swapped left and right of the whole body.

    A swap with mirrored depth changes a yaw about the vertical axis of the camera into pi minus the yaw: a jump in
    front and back views. In side views both are equal, so the neighbouring frames decide.
    """
    rows = np.flatnonzero(has_torso_landmarks(observations))
    if len(rows) == 0:
        return np.zeros(len(observations.time_s), dtype=bool)
    in_camera = _camera_rotation(observations) @ torso_rotations(rest_landmarks_m, observations.landmarks_3d_m[rows])
    yaw_rad = facing_yaw_rad(CAMERA_TO_Y_UP @ in_camera).numpy()
    free = FREE_YAW_CHANGE_RAD * _time_steps(observations, rows)
    same = YAW_CHANGE_COST * np.maximum(np.abs(_wrap_angle(yaw_rad[1:] - yaw_rad[:-1])) - free, 0.0)
    other = YAW_CHANGE_COST * np.maximum(np.abs(_wrap_angle(np.pi - yaw_rad[1:] - yaw_rad[:-1])) - free, 0.0)
    unary = np.tile([0.0, SWAP_COST], (len(rows), 1))
    return _scatter_to_frames(viterbi_two_labels(unary, same, other), rows, len(observations.time_s))


def detect_limb_swaps(observations: Observations, limb: str) -> Bool[np.ndarray, "n"]:
    """Return the frames in which the detector swapped the arms or the legs, from jumps in the image and wrong sides."""
    pairs, order_pair, torso = LIMB_SWAP_PAIRS[limb]
    rows = np.flatnonzero(has_torso_landmarks(observations))
    if len(rows) == 0:
        return np.zeros(len(observations.time_s), dtype=bool)
    landmarks = observations.landmarks_px[rows].numpy()
    directions = observations.landmarks_3d_m[rows].numpy()
    torso_px = np.linalg.norm(landmarks[:, [11, 12]].mean(1) - landmarks[:, [23, 24]].mean(1), axis=1)
    left, right = zip(*(pair for pair in pairs if pair[0] < POSE_LANDMARK_COUNT), strict=True)
    limb_px, swapped_px = landmarks[:, left + right], landmarks[:, right + left]
    size = LANDMARK_JUMP_COST / np.maximum(np.median(torso_px), 1.0) / _time_steps(observations, rows)
    same = size * np.linalg.norm(limb_px[1:] - limb_px[:-1], axis=2).mean(1)
    other = size * np.linalg.norm(limb_px[1:] - swapped_px[:-1], axis=2).mean(1)
    across = directions[:, torso[0]] - directions[:, torso[1]]
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-6)
    side = ((directions[:, order_pair[0]] - directions[:, order_pair[1]]) * across).sum(1) / WRONG_SIDE_DISTANCE_M
    unary = WRONG_SIDE_COST * np.stack([np.clip(-side, 0.0, 1.0), SWAP_COST + np.clip(side, 0.0, 1.0)], axis=1)
    return _scatter_to_frames(viterbi_two_labels(unary, same, other), rows, len(observations.time_s))


def swap_body_left_right(observations: Observations, left_right_swapped: Bool[np.ndarray, "n"]) -> Observations:
    """Swap all left and right landmarks in the selected frames, and mirror their 3D positions in depth.

    With left and right swapped, the same pixels are those of the person seen from behind, with opposite depths.
    """
    to_camera = _camera_rotation(observations)
    mirror = to_camera.T @ torch.diag(torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64)) @ to_camera
    swapped = _swap_landmarks(observations, left_right_swapped, SWAP_PAIR_GROUPS["whole body"])
    directions = swapped.landmarks_3d_m.clone()
    directions[torch.from_numpy(left_right_swapped)] @= mirror.T
    return replace(swapped, landmarks_3d_m=directions)


def swap_limb_left_right(
    observations: Observations, left_right_swapped: Bool[np.ndarray, "n"], limb: str
) -> Observations:
    """Swap the landmarks of arms or legs in the selected frames."""
    return _swap_landmarks(observations, left_right_swapped, LIMB_SWAP_PAIRS[limb].swapped)


def _swap_landmarks(
    observations: Observations, left_right_swapped: Bool[np.ndarray, "n"], pairs: tuple[tuple[int, ...], ...]
) -> Observations:
    order, rows = mirror_permutation(pairs), torch.from_numpy(left_right_swapped)

    def permute(values: torch.Tensor) -> torch.Tensor:
        result = values.clone()
        result[rows] = values[rows][:, order]
        return result

    return replace(
        observations,
        landmarks_px=permute(observations.landmarks_px),
        landmarks_3d_m=permute(observations.landmarks_3d_m),
        confidence=permute(observations.confidence),
        confidence_3d=permute(observations.confidence_3d),
    )


def _camera_rotation(observations: Observations) -> Float[torch.Tensor, "3 3"]:
    return torch.as_tensor(observations.camera.world_to_camera, dtype=torch.float64)[:3, :3]


def _time_steps(observations: Observations, rows: Int[np.ndarray, "k"]) -> Float[np.ndarray, "t"]:
    """Return the interval between successive rows in units of `MIN_INTERVAL_S`, at least 1."""
    return np.maximum(np.diff(observations.time_s.numpy()[rows]) / MIN_INTERVAL_S, 1.0)


def _scatter_to_frames(labels: Bool[np.ndarray, "k"], rows: np.ndarray, frames: int) -> Bool[np.ndarray, "n"]:
    scattered = np.zeros(frames, dtype=bool)
    scattered[rows] = labels
    return scattered


def _wrap_angle(angle_rad: np.ndarray) -> np.ndarray:
    return (angle_rad + np.pi) % (2 * np.pi) - np.pi
