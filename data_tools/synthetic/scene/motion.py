"""Built-in motions of synthetic people: a turn in A-pose with natural sway, and novel poses for evaluation."""

import numpy as np
import torch
from jaxtyping import Float

from pipeline.avatar.motion.feet import snap_feet_to_floor
from pipeline.body.body import Body, Motion
from pipeline.geometry.rotation import (
    axis_angle_to_quaternion,
    quaternion_conjugate,
    quaternion_multiply,
    quaternion_to_matrix,
)

JointAngles = dict[str, tuple[float, float, float]]
"""Axis-angle (radians, canonical axes) by joint name; other joints have the identity rotation."""

_SWAY: dict[str, tuple[tuple[float, float, float], float]] = {
    "Spine": ((0.016, 0.030, 0.014), 2.9),
    "Spine1": ((0.014, 0.022, 0.012), 2.3),
    "Neck": ((0.030, 0.040, 0.015), 3.4),
    "Head": ((0.025, 0.045, 0.020), 2.6),
    "LeftArm": ((0.030, 0.035, 0.050), 3.1),
    "RightArm": ((0.030, 0.035, 0.050), 2.7),
    "LeftForeArm": ((0.025, 0.045, 0.025), 2.2),
    "RightForeArm": ((0.025, 0.045, 0.025), 2.5),
    "LeftHand": ((0.050, 0.020, 0.050), 2.0),
    "RightHand": ((0.050, 0.020, 0.050), 2.4),
}
"""Amplitude (radians about x, y, z) and period (s) of the slow oscillation of each joint."""

_POSTURE: dict[str, tuple[tuple[float, float, float], float]] = {
    "LeftArm": ((0.10, 0.05, 0.21), 1.0),
    "RightArm": ((0.10, 0.05, 0.21), 1.2),
    "LeftForeArm": ((0.05, 0.12, 0.08), 0.9),
    "RightForeArm": ((0.05, 0.12, 0.08), 1.1),
    "Neck": ((0.05, 0.11, 0.02), 0.8),
    "Head": ((0.07, 0.18, 0.03), 0.9),
    "Spine1": ((0.05, 0.05, 0.03), 1.3),
    "LeftUpLeg": ((0.04, 0.03, 0.05), 1.5),
    "RightUpLeg": ((0.04, 0.03, 0.05), 1.3),
}
"""Amplitude (radians about x, y, z) and period (turns) of the posture that changes over several turns.

The slow part of each signal has 1.6 times the period, so no two turns are equal.
"""

_HIP_SHIFT_RAD, _HIP_SHIFT_TURNS = 0.05, 1.6
"""Pelvis tilt of standing on one leg and then on the other, and its period in turns."""

BREATH_PERIOD_S = 3.6

NOVEL_POSES: dict[str, JointAngles] = {
    "arms_up": {"LeftArm": (0.0, 0.0, 1.55), "RightArm": (0.0, 0.0, -1.55)},
    "stride": {
        "LeftUpLeg": (-0.55, 0.0, 0.0),
        "LeftLeg": (0.35, 0.0, 0.0),
        "RightUpLeg": (0.35, 0.0, 0.0),
        "RightLeg": (0.45, 0.0, 0.0),
        "LeftArm": (0.45, 0.0, -0.45),
        "RightArm": (-0.50, 0.0, 0.45),
    },
    "squat": {
        "Spine": (0.35, 0.0, 0.0),
        "LeftUpLeg": (-1.15, 0.0, 0.0),
        "RightUpLeg": (-1.15, 0.0, 0.0),
        "LeftLeg": (1.55, 0.0, 0.0),
        "RightLeg": (1.55, 0.0, 0.0),
        "LeftFoot": (-0.40, 0.0, 0.0),
        "RightFoot": (-0.40, 0.0, 0.0),
    },
    "wave": {
        "RightArm": (0.0, 0.0, -1.0),
        "RightForeArm": (0.0, 0.0, -0.9),
        "Head": (0.05, 0.35, 0.0),
        "LeftArm": (0.0, 0.0, -0.4),
    },
}
"""Poses that do not occur in the turn; they test the skinning of an avatar."""

HAND_ON_HIP: JointAngles = {"LeftForeArm": (-0.25, 0.0, -1.5)}
"""Bend of the left elbow that brings the hand to the hip."""


def turn_in_a_pose(
    body: Body,
    frame_count: int,
    fps: float,
    ground_m: Float[np.ndarray, "3"],
    seed: int,
    arc_deg: float = 360.0,
    turns: int = 1,
) -> Motion:
    """Generate full turns on the spot with swaying arms, breathing and weight shift between the feet.

    The last frame is one step before the heading of the first frame, so that headings are evenly spaced.

    Args:
        ground_m: world position between the feet, metres.
        seed: of the phases of the sway.
        arc_deg: total angle; below 360 the person turns by half of it to each side and back.
        turns: number of full turns; with more than one the posture (arms, head, weight, legs) changes smoothly within
            and between them, by up to about 15 degrees.
    """
    time_s = np.arange(frame_count) / fps
    random = np.random.default_rng([seed, 2])
    axis_angles = np.zeros((frame_count, len(body.joint_names), 3))
    for name, (amplitude_rad, period) in _SWAY.items():
        _add_rotation(axis_angles, body, name, _smooth_random_signals(time_s, period, random) * amplitude_rad)
    _breathe(axis_angles, body, time_s)
    _shift_weight(axis_angles, body, time_s)
    turn_fraction = np.arange(frame_count) / frame_count
    if turns > 1:
        _change_posture(axis_angles, body, turns * turn_fraction, random)
        turn_fraction = turns * turn_fraction
    heading = 2.0 * np.pi * (turn_fraction + 0.012 * np.sin(4.0 * np.pi * turn_fraction))
    if arc_deg < 360.0:
        heading = np.radians(0.5 * arc_deg) * np.sin(heading)
    return _motion_on_ground(body, axis_angles, heading, ground_m, time_s)


def novel_motion(body: Body, ground_m: Float[np.ndarray, "3"], count: int) -> Motion:
    """Return `count` frames that cycle through `NOVEL_POSES`, each with a different heading."""
    axis_angles = np.zeros((count, len(body.joint_names), 3))
    poses = list(NOVEL_POSES.values())
    for frame in range(count):
        for name, angles in poses[frame % len(poses)].items():
            _add_rotation(axis_angles[frame : frame + 1], body, name, np.array(angles))
    heading = np.resize([0.35, -0.70, 0.90, -0.20], count) + 2.1 * (np.arange(count) // len(poses))
    return _motion_on_ground(body, axis_angles, heading, ground_m, np.arange(count, dtype=float))


def bend_at_hips(body: Body, motion: Motion, bend_deg: float) -> Motion:
    """Bend the trunk forward about the axis through both hip joints; the legs keep their positions and rotations.

    The bend is constant in the frame of the body. Positive angles bend forward.
    """
    hips, legs = body.joint("Hips"), [body.joint("LeftUpLeg"), body.joint("RightUpLeg")]
    bend = axis_angle_to_quaternion(torch.tensor([np.radians(bend_deg), 0.0, 0.0], dtype=torch.float64))
    rotations = torch.from_numpy(motion.rotations_wxyz).double()
    hips_rotation = quaternion_to_matrix(rotations[:, hips])
    centre_m = torch.from_numpy(body.joints_m[legs].mean(0) - body.joints_m[hips]).double()
    shift_m = hips_rotation @ (centre_m - quaternion_to_matrix(bend) @ centre_m)
    rotations[:, hips] = quaternion_multiply(rotations[:, hips], bend.expand(len(rotations), 4))
    unbend = quaternion_conjugate(bend).expand(len(rotations), len(legs), 4)
    rotations[:, legs] = quaternion_multiply(unbend, rotations[:, legs])
    return motion.with_pose(rotations.float().numpy(), (motion.root_translation_m + shift_m.numpy()).astype(np.float32))


def posture(lower_arms_deg: float, close_legs_deg: float, hand_on_hip: bool) -> JointAngles:
    """Return joint angles that lower both arms, close both legs (feet stay level), and put the left hand on the hip.

    The hand is on the hip of a person whose upper arm is at 45 degrees in the A-pose.
    """
    arm, leg = np.radians(lower_arms_deg), np.radians(close_legs_deg)
    angles: JointAngles = {"LeftArm": (0.0, 0.0, -arm), "RightArm": (0.0, 0.0, arm)}
    angles |= {"LeftUpLeg": (0.0, 0.0, -leg), "RightUpLeg": (0.0, 0.0, leg)}
    angles |= {"LeftFoot": (0.0, 0.0, leg), "RightFoot": (0.0, 0.0, -leg)}
    return angles | (HAND_ON_HIP if hand_on_hip else {})


def add_joint_angles(body: Body, motion: Motion, angles: JointAngles) -> Motion:
    """Rotate joints by constant angles in the frame of their parents, before their own motion; feet stay on the floor.

    Joints that the rig does not have are skipped.
    """
    rotations = torch.from_numpy(motion.rotations_wxyz).double()
    for name, angle in angles.items():
        if name in body.joint_names:
            joint = body.joint(name)
            constant = axis_angle_to_quaternion(torch.tensor(angle, dtype=torch.float64))
            rotations[:, joint] = quaternion_multiply(constant.expand(len(rotations), 4), rotations[:, joint])
    return motion.with_pose(rotations.float().numpy(), motion.root_translation_m)


def _smooth_random_signals(
    time_s: np.ndarray, period_s: float, random: np.random.Generator
) -> Float[np.ndarray, "n 3"]:
    """Return three smooth signals in [-1, 1], each the sum of two sines with random phases."""
    phase = random.uniform(0.0, 2.0 * np.pi, (2, 3))
    slow = np.sin(2.0 * np.pi * time_s[:, None] / (1.6 * period_s) + phase[0])
    return 0.65 * slow + 0.35 * np.sin(2.0 * np.pi * time_s[:, None] / (0.71 * period_s) + phase[1])


def _add_rotation(axis_angles: Float[np.ndarray, "n j 3"], body: Body, name: str, angles: np.ndarray) -> None:
    """Add axis-angle components to a joint, in place; skip a joint that the rig does not have."""
    if name in body.joint_names:
        axis_angles[:, body.joint(name)] += angles


def _breathe(axis_angles: np.ndarray, body: Body, time_s: np.ndarray) -> None:
    """Add the rotation of chest and shoulders by breathing, in place."""
    breath = np.sin(2.0 * np.pi * time_s / BREATH_PERIOD_S)
    for name, amplitude_rad in (
        ("Spine2", (-0.014, 0, 0)),
        ("LeftShoulder", (0, 0, 0.016)),
        ("RightShoulder", (0, 0, -0.016)),
    ):
        _add_rotation(axis_angles, body, name, breath[:, None] * amplitude_rad)


def _change_posture(axis_angles: np.ndarray, body: Body, turned: np.ndarray, random: np.random.Generator) -> None:
    """Add the slow change of posture over several turns, in place; `turned` is the number of turns at each frame."""
    for name, (amplitude_rad, period_turns) in _POSTURE.items():
        _add_rotation(axis_angles, body, name, _smooth_random_signals(turned, period_turns, random) * amplitude_rad)
    _tilt_pelvis(axis_angles, body, _HIP_SHIFT_RAD * np.sin(2.0 * np.pi * turned / _HIP_SHIFT_TURNS))


def _tilt_pelvis(axis_angles: np.ndarray, body: Body, tilt_rad: np.ndarray) -> None:
    """Tilt the pelvis to the side, in place; legs and spine compensate it."""
    for name, sign in (("Hips", 1.0), ("LeftUpLeg", -1.0), ("RightUpLeg", -1.0), ("Spine", -1.0)):
        _add_rotation(axis_angles, body, name, tilt_rad[:, None] * (0.0, 0.0, sign))


def _shift_weight(axis_angles: np.ndarray, body: Body, time_s: np.ndarray) -> None:
    """Add the pelvis tilt of shifting weight, in place; legs and spine compensate it."""
    _tilt_pelvis(axis_angles, body, 0.022 * np.sin(2.0 * np.pi * time_s / 2.1))
    step = np.maximum(np.sin(2.0 * np.pi * time_s / 1.05), 0.0), np.maximum(-np.sin(2.0 * np.pi * time_s / 1.05), 0.0)
    for side, lift in zip(("Left", "Right"), step, strict=True):
        for part, angle in (("UpLeg", -0.07), ("Leg", 0.13), ("Foot", -0.06)):
            _add_rotation(axis_angles, body, side + part, lift[:, None] * (angle, 0.0, 0.0))


def _motion_on_ground(
    body: Body, axis_angles: np.ndarray, heading: np.ndarray, ground_m: np.ndarray, time_s: np.ndarray
) -> Motion:
    """Rotate the person by `heading` (radians about +Y) and place the feet on the floor at `ground_m`."""
    rotations = axis_angle_to_quaternion(torch.from_numpy(axis_angles))
    heading_axis_angle = torch.zeros(len(heading), 3, dtype=torch.float64)
    heading_axis_angle[:, 1] = torch.from_numpy(heading)
    rotations[:, 0] = quaternion_multiply(axis_angle_to_quaternion(heading_axis_angle), rotations[:, 0])
    root = np.repeat(ground_m[None], len(heading), axis=0) * [1.0, 0.0, 1.0]
    motion = Motion(
        frame_index=np.arange(len(heading), dtype=np.int32),
        time_s=time_s.astype(np.float64),
        rotations_wxyz=rotations.numpy().astype(np.float32),
        root_translation_m=root.astype(np.float32),
    )
    return snap_feet_to_floor(body, motion, float(ground_m[1]))
