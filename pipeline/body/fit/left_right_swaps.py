"""Landmarks whose left and right the detector took for each other, found by what cannot happen in time.

A person does not turn by half a circle between two frames, and a limb does not jump to where the other one was. Both
are decided by dynamic programming over two labels a frame (as found, exchanged), so that a whole run of wrong frames is
seen by its two ends.
"""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from pipeline.body.fit.energy import Observations
from pipeline.body.fit.initialisation import facing_yaw, torso_found, torso_rotations
from pipeline.body.fit.landmark_regressor import PAIRS, POSE_LANDMARKS, SWAP_GROUPS, mirror_permutation

EXCHANGE_COST = 0.25
"""What it takes to believe that a frame is exchanged; the costs below are counted against it."""

STEP_S = 0.2
"""Frames up to this far apart count alike: what changes between them is mostly the detector's noise. In longer gaps
people move in proportion to the time."""

TURN_COST = 2.0
TURN_FREE_RAD = 0.35
"""Radians of turning in a step of `STEP_S` that cost nothing."""

JUMP_COST = 1.5
"""For limbs: cost of moving by the size of the torso in a step of `STEP_S`, mean over the limb's landmarks."""

SIDE_COST = 1.0
SIDE_M = 0.15
"""For limbs: cost of lying this far on the wrong side of the body (left knee right of the right one)."""

Y_UP = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
"""From camera axes (y down, z away) to such as `facing_yaw` reads: y up, z towards the viewer."""

LIMBS = {
    "arms": (SWAP_GROUPS["arms"], (13, 14), (11, 12)),
    "legs": (SWAP_GROUPS["legs"], (25, 26), (23, 24)),
}
"""Pairs that are exchanged together, the pair whose order tells, and the pair of the torso that it is compared with."""


def two_label_path(
    unary: Float[np.ndarray, "n 2"], same: Float[np.ndarray, "k"], other: Float[np.ndarray, "k"]
) -> Bool[np.ndarray, "n"]:
    """Cheapest sequence of labels (Viterbi): `unary` costs a frame, `same` and `other` cost keeping or changing the
    label between neighbours. True where label 1 wins."""
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


def exchanged_bodies(observations: Observations, rest_m: Float[torch.Tensor, "l 3"]) -> Bool[np.ndarray, "n"]:
    """Frames in which the whole person was taken for one who faces the other way, by the continuity of turning.

    Exchanged sides with mirrored depths turn a yaw about the camera's upright axis into pi minus the yaw: a jump in
    front and back views. In a side view the two agree, and nothing tells them apart.
    """
    rows = np.flatnonzero(torso_found(observations))
    if len(rows) == 0:
        return np.zeros(len(observations.time_s), dtype=bool)
    in_camera = _camera_rotation(observations) @ torso_rotations(rest_m, observations.directions_m[rows])
    yaw_rad = facing_yaw(Y_UP @ in_camera).numpy()
    free = TURN_FREE_RAD * _steps(observations, rows)
    same = TURN_COST * np.maximum(np.abs(_wrapped(yaw_rad[1:] - yaw_rad[:-1])) - free, 0.0)
    other = TURN_COST * np.maximum(np.abs(_wrapped(np.pi - yaw_rad[1:] - yaw_rad[:-1])) - free, 0.0)
    unary = np.tile([0.0, EXCHANGE_COST], (len(rows), 1))
    return _spread(two_label_path(unary, same, other), rows, len(observations.time_s))


def exchanged_limbs(observations: Observations, limb: str) -> Bool[np.ndarray, "n"]:
    """Frames in which arms or legs are exchanged, by jumps in the image and by the side they lie on."""
    pairs, telling, torso = LIMBS[limb]
    rows = np.flatnonzero(torso_found(observations))
    if len(rows) == 0:
        return np.zeros(len(observations.time_s), dtype=bool)
    landmarks = observations.landmarks_px[rows].numpy()
    directions = observations.directions_m[rows].numpy()
    torso_px = np.linalg.norm(landmarks[:, [11, 12]].mean(1) - landmarks[:, [23, 24]].mean(1), axis=1)
    left, right = zip(*(pair for pair in pairs if pair[0] < POSE_LANDMARKS), strict=True)
    limb_px, exchanged_px = landmarks[:, left + right], landmarks[:, right + left]
    size = JUMP_COST / np.maximum(np.median(torso_px), 1.0) / _steps(observations, rows)
    same = size * np.linalg.norm(limb_px[1:] - limb_px[:-1], axis=2).mean(1)
    other = size * np.linalg.norm(limb_px[1:] - exchanged_px[:-1], axis=2).mean(1)
    across = directions[:, torso[0]] - directions[:, torso[1]]
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-6)
    side = ((directions[:, telling[0]] - directions[:, telling[1]]) * across).sum(1) / SIDE_M
    unary = SIDE_COST * np.stack([np.clip(-side, 0.0, 1.0), EXCHANGE_COST + np.clip(side, 0.0, 1.0)], axis=1)
    return _spread(two_label_path(unary, same, other), rows, len(observations.time_s))


def exchange_bodies(observations: Observations, exchanged: Bool[np.ndarray, "n"]) -> Observations:
    """All left and right landmarks trade places in some frames; their 3D positions are mirrored in depth.

    A picture does not tell front from back: the same pixels with left and right exchanged belong to the person seen
    from the other side, whose depths are opposite.
    """
    to_camera = _camera_rotation(observations)
    mirror = to_camera.T @ torch.diag(torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64)) @ to_camera
    swapped = _exchange(observations, exchanged, PAIRS)
    directions = swapped.directions_m.clone()
    directions[torch.from_numpy(exchanged)] @= mirror.T
    return replace(swapped, directions_m=directions)


def exchange_limbs(observations: Observations, exchanged: Bool[np.ndarray, "n"], limb: str) -> Observations:
    """The landmarks of arms or legs trade places in some frames."""
    return _exchange(observations, exchanged, LIMBS[limb][0])


def _exchange(
    observations: Observations, exchanged: Bool[np.ndarray, "n"], pairs: tuple[tuple[int, ...], ...]
) -> Observations:
    order, rows = mirror_permutation(pairs), torch.from_numpy(exchanged)

    def traded(values: torch.Tensor) -> torch.Tensor:
        result = values.clone()
        result[rows] = values[rows][:, order]
        return result

    return replace(
        observations,
        landmarks_px=traded(observations.landmarks_px),
        directions_m=traded(observations.directions_m),
        confidence=traded(observations.confidence),
        direction_confidence=traded(observations.direction_confidence),
    )


def _camera_rotation(observations: Observations) -> Float[torch.Tensor, "3 3"]:
    return torch.as_tensor(observations.camera.world_to_camera, dtype=torch.float64)[:3, :3]


def _steps(observations: Observations, rows: Int[np.ndarray, "k"]) -> Float[np.ndarray, "t"]:
    """Time from each of some frames to the next, in steps of `STEP_S`, at least one."""
    return np.maximum(np.diff(observations.time_s.numpy()[rows]) / STEP_S, 1.0)


def _spread(labels: Bool[np.ndarray, "k"], rows: np.ndarray, frames: int) -> Bool[np.ndarray, "n"]:
    everywhere = np.zeros(frames, dtype=bool)
    everywhere[rows] = labels
    return everywhere


def _wrapped(angle_rad: np.ndarray) -> np.ndarray:
    return (angle_rad + np.pi) % (2 * np.pi) - np.pi
