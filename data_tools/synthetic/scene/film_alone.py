"""A person who films alone: from the camera to their place and, after the turn, back to the camera."""

import numpy as np
import torch
from jaxtyping import Float

from pipeline.avatar.motion.feet import snap_feet_to_floor
from pipeline.body.body import Body, Motion
from pipeline.geometry.rotation import axis_angle_to_quaternion, quaternion_multiply

MIN_FRAMES = 60
_SHARES = (0.18, 0.07, 0.05, 0.5, 0.2)
"""Of the frames: walking away from the camera, turning around to it, standing, the turn, walking to it."""
_NEAREST_M = 0.7
"""Horizontal distance from the camera at both ends."""
_STEPS_PERIOD_S, _THIGH_RAD, _KNEE_RAD = 1.1, 0.35, 0.3
"""Duration of two steps, swing of a thigh to either side, and mean bend of a knee."""


def film_alone(body: Body, turn: Motion, ground_m: Float[np.ndarray, "3"], camera_m: Float[np.ndarray, "3"]) -> Motion:
    """Return as many frames of a person who comes from the camera, turns as in `turn`, and goes back to it.

    turn: a full turn of at least `MIN_FRAMES` frames that begins facing the camera. ground_m: where the person turns
    (world). camera_m: centre of the camera.
    """
    count = len(turn.frame_index)
    away, around, stand, turned, back = np.diff(np.round(np.cumsum((0.0, *_SHARES)) * count).astype(int))
    rows = (
        np.full(away, count // 2),
        np.linspace(count // 2, count - 1, around),
        np.zeros(stand),
        np.linspace(0, count - 1, turned),
        np.full(back, count - 1),
    )
    source = np.concatenate(rows).round().astype(int)
    share = np.concatenate([np.linspace(1.0, 0.0, away), np.zeros(count - away - back), np.linspace(0.0, 1.0, back)])
    to_camera_m = (camera_m - ground_m) * [1.0, 0.0, 1.0]
    shift_m = share[:, None] * to_camera_m * (1.0 - _NEAREST_M / np.linalg.norm(to_camera_m))
    rotations = torch.from_numpy(turn.rotations_wxyz[source]).double()
    phase = 2.0 * np.pi * turn.time_s / _STEPS_PERIOD_S * (share > 0.0)
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        thigh_rad = sign * _THIGH_RAD * np.sin(phase)
        knee_rad = _KNEE_RAD * (1.0 + np.cos(phase) * sign) * (share > 0.0)
        for part, angle_rad in (("UpLeg", thigh_rad), ("Leg", knee_rad)):
            joint = body.joint(side + part)
            axis_angle = torch.from_numpy(angle_rad[:, None] * (1.0, 0.0, 0.0))
            rotations[:, joint] = quaternion_multiply(rotations[:, joint], axis_angle_to_quaternion(axis_angle))
    root_m = (turn.root_translation_m[source] + shift_m).astype(np.float32)
    return snap_feet_to_floor(body, turn.with_pose(rotations.float().numpy(), root_m), float(ground_m[1]))
