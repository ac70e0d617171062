"""A clip of the avatar standing and breathing, which repeats without a seam."""

import numpy as np
import torch
from jaxtyping import Float

from pipeline.avatar.motion.feet import snap_feet_to_floor
from pipeline.body.body import Body, Motion
from pipeline.body.fit.ground_contact import SOLE_JOINTS
from pipeline.geometry.rotation import axis_angle_to_quaternion

DURATION_S, FPS = 7.2, 30
BREATHS = 2
"""Of the clip, so 17 a minute."""

_STANCE_RAD = {
    "Shoulder": (0.0, 0.0, -0.03),
    "Arm": (0.0, 0.0, -0.42),
    "ForeArm": (0.22, -0.12, 0.0),
}
"""Rotation vectors of the left side that lower the arms of the A-pose; mirrored in x for the right."""

_BREATH_RAD = {
    "Spine1": (-0.008, 0.0, 0.0),
    "Spine2": (-0.022, 0.0, 0.0),
    "Neck": (0.02, 0.0, 0.0),
    "LeftShoulder": (0.0, 0.0, 0.03),
    "LeftArm": (0.0, 0.0, -0.02),
    "RightShoulder": (0.0, 0.0, -0.03),
    "RightArm": (0.0, 0.0, 0.02),
}
_SWAY_RAD = {"Spine": (0.006, 0.012, 0.008), "Head": (0.012, -0.03, -0.008)}
"""Amplitudes (radians about x, y, z) of breathing, and of the sway, which has one period in the clip."""


def idle_motion(body: Body, floor_y_m: float) -> Motion:
    """Return the clip on a floor; its last frame equals its first. Joints that are missing are left out."""
    time_s = np.arange(round(DURATION_S * FPS) + 1) / FPS
    phase = 2.0 * np.pi * time_s / DURATION_S
    axis_angles = np.zeros((len(time_s), len(body.joint_names), 3))
    breath = 0.5 - 0.5 * np.cos(BREATHS * phase)
    for side, mirror in (("Left", (1.0, 1.0, 1.0)), ("Right", (1.0, -1.0, -1.0))):
        for part, angles in _STANCE_RAD.items():
            _add(axis_angles, body, side + part, np.multiply(angles, mirror)[None])
    for name, amplitude in _BREATH_RAD.items():
        _add(axis_angles, body, name, breath[:, None] * amplitude)
    for name, amplitude in _SWAY_RAD.items():
        _add(axis_angles, body, name, np.sin(phase + [[0.0], [0.7], [1.9]]).T * amplitude)
    rotations = axis_angle_to_quaternion(torch.from_numpy(axis_angles)).numpy()
    root_m = np.repeat(body.joints_m[:1] + np.array([0.0, floor_y_m, 0.0], np.float32), len(time_s), axis=0)
    motion = Motion(np.arange(len(time_s), dtype=np.int32), time_s, rotations.astype(np.float32), root_m)
    return snap_feet_to_floor(body, motion, floor_y_m) if set(SOLE_JOINTS) <= set(body.joint_names) else motion


def _add(axis_angles: Float[np.ndarray, "n j 3"], body: Body, name: str, angles_rad: Float[np.ndarray, "#n 3"]) -> None:
    if name in body.joint_names:
        axis_angles[:, body.joint(name)] += angles_rad
