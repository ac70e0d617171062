"""Joint limits: angles against closed forms, feasible and infeasible poses, fits to infeasible landmarks."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from data_tools.synthetic.scene.motion import NOVEL_POSES
from pipeline.avatar.motion.retarget import retarget
from pipeline.body.body import load_anny
from pipeline.body.fit.camera_parameters import INTRINSICS_COUNT
from pipeline.body.fit.energy import EnergyParameters, Objective
from pipeline.body.fit.landmark_regressor import LANDMARK_COUNT, LANDMARK_OFFSET_COUNT, landmark_regressor
from pipeline.body.fit.levenberg_marquardt import minimise
from pipeline.body.fit.linear_body import ACTIVE_JOINTS, LinearBody, linearise_body
from pipeline.body.fit.posed_points import pose_points, pose_skeleton
from pipeline.body.fit.prior.joint_limits import (
    BALL_JOINT_RANGES_DEG,
    LIMIT_STD_RAD,
    JointLimits,
    joint_limits,
    strip_side,
    swing_twist,
)
from pipeline.body.fit.prior.priors import pose_prior, shape_prior
from pipeline.body.fit.state import FitState, Observations
from pipeline.body.smpl import SmplBody
from pipeline.geometry.camera import Camera, project
from pipeline.geometry.rotation import axis_angle_to_matrix, matrix_to_quaternion, quaternion_to_matrix
from pipeline.io.bvh import read_bvh
from tests.body.acting import relative_to_line_of_sight
from tests.body.smpl_sample import sample_arrays

MIRROR = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
Pose = dict[str, tuple[float, float, float]]

# Degrees about the body's x, y, z, of the left side; the arm rests 48 degrees below the horizontal.
FEASIBLE: dict[str, Pose] = {
    "arm straight up": {"LeftArm": (0, 0, 135)},
    "arm hangs": {"LeftArm": (0, 0, -41)},
    "arm held back": {"LeftArm": (55, 0, -41)},
    "arm forward": {"LeftArm": (0, -85, 40)},
    "thigh at the belly": {"LeftUpLeg": (-125, 0, 0), "LeftLeg": (140, 0, 0)},
    "thigh held back": {"LeftUpLeg": (30, 0, 0)},
    "legs astride": {"LeftUpLeg": (0, 0, 45)},
    "kick to the side": {"LeftUpLeg": (0, 0, 85)},
    "legs crossed": {"LeftUpLeg": (-20, 0, -25)},
    "toes turned out": {"LeftUpLeg": (0, 45, 0)},
    "deep squat": {"LeftUpLeg": (-115, 0, 0), "LeftLeg": (140, 0, 0), "LeftFoot": (-35, 0, 0), "Spine": (30, 0, 0)},
    "tiptoe": {"LeftFoot": (50, 0, 0), "LeftToeBase": (-60, 0, 0)},
    "looks over the shoulder": {"Neck": (0, 25, 0), "Head": (0, 55, 0)},
    "chin on the chest": {"Neck": (40, 0, 0), "Head": (20, 0, 0)},
    "touches the floor": {"Spine": (35, 0, 0), "Spine1": (25, 0, 0), "Spine2": (20, 0, 0), "LeftUpLeg": (-80, 0, 0)},
}
INFEASIBLE: dict[str, tuple[str, tuple[float, float, float]]] = {
    "thigh straight back": ("LeftUpLeg", (90, 0, 0)),
    "thigh across the other": ("LeftUpLeg", (0, 0, -80)),
    "foot turned round": ("LeftUpLeg", (0, 130, 0)),
    "elbow turned round": ("LeftArm", (-150, 0, 0)),
    "ear below the shoulder": ("Neck", (0, 0, 90)),
    "head at the nape": ("Head", (-80, 0, 0)),
    "face to the back": ("Head", (0, 120, 0)),
    "waist wrung": ("Spine1", (0, 80, 0)),
    "broken back": ("Spine", (-60, 0, 0)),
    "collarbone at the ear": ("LeftShoulder", (0, 0, 90)),
    "shin at the toes": ("LeftFoot", (-90, 0, 0)),
    "toes aside": ("LeftToeBase", (0, 60, 0)),
}


@pytest.fixture(scope="module")
def model() -> LinearBody:
    body = load_anny()
    return linearise_body(body, body.shape_defaults)


@pytest.fixture(scope="module")
def limits(model: LinearBody) -> JointLimits:
    return joint_limits(model)


def posed(pose: Pose, side: str = "Left") -> torch.Tensor:
    """Return the rotations of all joints; the right side mirrors the left."""
    angles = torch.zeros(1, len(ACTIVE_JOINTS), 3, dtype=torch.float64)
    for name, degrees in pose.items():
        turn = torch.deg2rad(torch.tensor(degrees, dtype=torch.float64))
        angles[0, ACTIVE_JOINTS.index(name.replace("Left", side))] = turn if side == "Left" else turn * MIRROR
    return axis_angle_to_matrix(angles)


def excess_deg(limits: JointLimits, rotations: torch.Tensor) -> torch.Tensor:
    """Return the excess of each joint over its limits, largest of the three angles."""
    return torch.rad2deg(limits.residuals(rotations)[0].abs().amax(-1) * LIMIT_STD_RAD)


@pytest.mark.parametrize("twist", [0.0, -1e-5, 0.7, -2.9])
@pytest.mark.parametrize("swing", [(0.0, 0.0), (1e-5, 0.0), (-0.9, 0.4), (1.1, 2.4)])
def test_twist_and_swing_are_recovered(twist: float, swing: tuple[float, float]) -> None:
    turn = torch.tensor([[0.0, *swing], [twist, 0.0, 0.0]], dtype=torch.float64)
    rotation = axis_angle_to_matrix(turn[0]) @ axis_angle_to_matrix(turn[1])
    angles, _ = swing_twist(rotation)
    assert torch.allclose(angles, turn.sum(0), atol=1e-9)
    w, x, _, _ = matrix_to_quaternion(rotation)
    assert torch.allclose(angles[0], 2.0 * torch.atan2(x, w), atol=1e-9)


@pytest.mark.parametrize("size", [1e-7, 1e-2, 1.0, 2.7])
def test_derivative_of_swing_and_twist_agrees_with_differences(size: float) -> None:
    direction = torch.nn.functional.normalize(torch.tensor([0.4, -0.7, 0.6], dtype=torch.float64), dim=0)
    rotation = axis_angle_to_matrix(size * direction)
    columns = [
        (swing_twist(axis_angle_to_matrix(step) @ rotation)[0] - swing_twist(axis_angle_to_matrix(-step) @ rotation)[0])
        for step in 1e-5 * torch.eye(3, dtype=torch.float64)
    ]
    assert torch.allclose(swing_twist(rotation)[1], torch.stack(columns, dim=1) / 2e-5, atol=1e-6)


def test_derivative_of_the_limits_agrees_with_differences(limits: JointLimits) -> None:
    """In random poses, most of which exceed some limit."""
    generator = torch.Generator().manual_seed(0)
    angles = 1.2 * torch.randn(6, len(ACTIVE_JOINTS), 3, generator=generator, dtype=torch.float64)
    step = 1e-6 * torch.randn(angles.shape, generator=generator, dtype=torch.float64)
    rotations = axis_angle_to_matrix(angles)
    residual, derivative = limits.residuals(rotations)
    ahead, behind = (limits.residuals(axis_angle_to_matrix(sign * step) @ rotations)[0] for sign in (1.0, -1.0))
    assert 0.3 < (residual[:, 1:] != 0).any(-1).double().mean() < 0.95
    assert torch.allclose((derivative @ step[..., None])[..., 0], 0.5 * (ahead - behind), atol=1e-7)


@pytest.mark.parametrize("side", ["Left", "Right"])
@pytest.mark.parametrize("pose", FEASIBLE)
def test_feasible_poses_cost_zeros(limits: JointLimits, pose: str, side: str) -> None:
    assert excess_deg(limits, posed(FEASIBLE[pose], side)).max() == 0.0


@pytest.mark.parametrize("side", ["Left", "Right"])
@pytest.mark.parametrize("pose", INFEASIBLE)
def test_infeasible_poses_exceed_the_limit_of_their_joint(limits: JointLimits, pose: str, side: str) -> None:
    name, degrees = INFEASIBLE[pose]
    excess = excess_deg(limits, posed({name: degrees}, side))[0]
    joint = ACTIVE_JOINTS.index(name.replace("Left", side))
    assert excess[joint] > 10.0
    assert excess.sum() == excess[joint]


@pytest.mark.parametrize(("turn_deg", "free"), [(70.0, True), (110.0, False), (-80.0, True), (-110.0, False)])
@pytest.mark.parametrize("side", ["Left", "Right"])
def test_wrists_flex_and_extend(model: LinearBody, limits: JointLimits, side: str, turn_deg: float, free: bool):
    """About the line from the knuckle of the index to that of the little finger; flexion is that of the fingers."""
    wrist, index, little, tip = (
        model.full_joints_m[model.joint_index_by_name[f"{side}Hand{part}"]]
        for part in ("", "Index1", "Pinky1", "Middle3")
    )
    axis = torch.nn.functional.normalize(little - index, dim=0) * (1.0 if side == "Left" else -1.0)
    curl = torch.linalg.cross(0.5 * (index + little) - wrist, tip - 0.5 * (index + little))
    assert axis @ curl > 0.0
    rotations = posed({})
    rotations[0, ACTIVE_JOINTS.index(f"{side}Hand")] = axis_angle_to_matrix(np.deg2rad(turn_deg) * axis)
    assert (excess_deg(limits, rotations).max() == 0.0) == free


@pytest.mark.parametrize(
    ("upper", "forearm", "free"),
    [
        ((1, 0, 0), (0, 0, 1), True),  # held sideways: forearm forward, up, down, not backward
        ((1, 0, 0), (0, 1, 0), True),
        ((1, 0, 0), (0, -1, 0.4), True),
        ((1, 0, 0), (0, 0, -1), False),
        ((0, 0, 1), (0, 1, 0), True),  # held forward: up, across, not outward
        ((0, 0, 1), (-1, 0, 0), True),
        ((0, 0, 1), (1, 0, 0), False),
        ((0, 1, 0), (-1, 0, 0), True),  # a hand over the head, behind the neck, on the other shoulder, behind the back
        ((0.6, 0.8, -0.1), (-0.8, -0.1, -0.5), True),
        ((-0.7, -0.1, 0.7), (-0.6, 0.3, -0.5), True),
        ((0.2, -0.9, -0.4), (-0.9, 0.1, -0.3), True),
        ((0, -1, 0), (0, 0, -1), False),  # hanging, with the forearm bent backward
        ((0, 0, -1), (1, 0, 0), False),  # straight back
        ((-0.8, 0.6, -0.3), (0, 0, 1), False),  # through the head
    ],
)
def test_upper_arm_limits_hold_in_all_directions(
    model: LinearBody, limits: JointLimits, upper: tuple, forearm: tuple, free: bool
) -> None:
    """Left arm: x outward, y up, z forward; the elbow is bent, so the direction of the forearm gives the twist."""
    arm, elbow, hand = (ACTIVE_JOINTS.index(f"Left{part}") for part in ("Arm", "ForeArm", "Hand"))
    rest = bone_frame(model.joints_m[elbow] - model.joints_m[arm], model.joints_m[hand] - model.joints_m[elbow])
    rotations = posed({})
    rotations[0, arm] = bone_frame(torch.tensor(upper).double(), torch.tensor(forearm).double()) @ rest.T
    assert (excess_deg(limits, rotations).max() == 0.0) == free


def bone_frame(upper: torch.Tensor, lower: torch.Tensor) -> torch.Tensor:
    """Return the rotation with the columns upper arm, elbow axis, and their cross product."""
    bone = torch.nn.functional.normalize(upper, dim=0)
    axis = torch.nn.functional.normalize(torch.linalg.cross(upper, lower), dim=0)
    return torch.stack([bone, axis, torch.linalg.cross(bone, axis)], dim=1)


@pytest.mark.parametrize("joints", [24, 55])
def test_smpl_bodies_have_the_same_limits(limits: JointLimits, joints: int) -> None:
    body = SmplBody(sample_arrays(joints))
    found, rest = joint_limits(linearise_body(body, body.shape_defaults)), posed({})
    assert (found.half_range_rad - found.angles(rest)[0].abs() > np.deg2rad(10.0))[0].all()
    for pose in FEASIBLE.values():
        assert torch.allclose(found.angles(posed(pose))[0], limits.angles(posed(pose))[0], atol=0.2)


def test_both_sides_have_the_same_limits(limits: JointLimits) -> None:
    generator = torch.Generator().manual_seed(1)
    for name in ("LeftUpLeg", "LeftArm", "LeftForeArm", "LeftHand", "LeftFoot", "LeftShoulder"):
        for degrees in (90.0 * torch.randn(20, 3, generator=generator)).tolist():
            sides = [excess_deg(limits, posed({name: degrees}, side)).max() for side in ("Left", "Right")]
            assert sides[0] == pytest.approx(sides[1], abs=1.0)


def test_novel_poses_of_synthetic_captures_are_feasible(limits: JointLimits) -> None:
    for pose in NOVEL_POSES.values():
        assert excess_deg(limits, posed({name: np.rad2deg(turn).tolist() for name, turn in pose.items()})).max() == 0.0


@pytest.mark.parametrize("name", ["cmu1_jumping_jacks", "fair1_zombie", "rokoko_jesse_dance"])
def test_recorded_motions_stay_within_the_limits(limits: JointLimits, shared_data: Path, name: str) -> None:
    """Jumping jacks, a staggering walk, and a dance with high kicks to the side. Without elbows and knees, whose axes
    differ between skeletons."""
    model = load_anny()
    body = model.at_shape(model.shape_defaults)
    motion = retarget(read_bvh(shared_data / "motions" / f"{name}.bvh"), body, np.zeros(3), in_place=True)
    everything = quaternion_to_matrix(torch.tensor(motion.rotations_wxyz, dtype=torch.float64))
    rotations = everything[:, [body.joint(joint) for joint in ACTIVE_JOINTS]]
    balls = [strip_side(joint) in BALL_JOINT_RANGES_DEG for joint in ACTIVE_JOINTS]
    excess = excess_deg(limits, rotations)[:, balls]
    print(
        f"{name}: {float((excess > 0).any(1).double().mean()):.4f} of frames, {float(excess.max()):.1f} degrees beyond"
    )
    assert excess.max() == 0.0


OUT_OF_RANGE: Pose = {
    "LeftUpLeg": (95, 0, 0),
    "LeftArm": (-150, 0, 0),
    "LeftFoot": (90, 0, 0),
    "Head": (0, 140, 0),
    "LeftHand": (0, 110, 0),
}
"""Infeasible angles of joints as detected in every frame, degrees."""


@pytest.fixture(scope="module")
def objective(model: LinearBody) -> Objective:
    """Return an objective of two frames without observations; landmarks outweigh the pose prior."""
    body, camera = load_anny(), Camera(520.0, 520.0, 128.0, 160.0, 256, 320)
    zeros = torch.zeros(2, LANDMARK_COUNT, 3, dtype=torch.float64)
    observations = Observations(
        torch.tensor([0.0, 0.1], dtype=torch.float64), zeros[..., :2], zeros, *2 * [zeros[..., 0] + 1.0], camera
    )
    priors = pose_prior(model), shape_prior(body.shape_names, body.shape_defaults)
    scale = torch.full((2,), 520.0 / 3.0, dtype=torch.float64)
    return Objective(
        model,
        landmark_regressor(model),
        *priors,
        observations,
        EnergyParameters(landmark_std_m=0.002, landmark_3d_std_m=0.005, free_shape=False),
        scale,
    )


def fitted(objective: Objective, pose: Pose, with_limits: bool) -> torch.Tensor:
    """Return the rotations fitted to the landmarks of a pose, with that pose as the initial state."""
    model, observations = objective.model, objective.observations
    zeros = [torch.zeros(count, dtype=torch.float64) for count in (LANDMARK_OFFSET_COUNT, INTRINSICS_COUNT)]
    root = torch.tensor([[0.0, -0.05, -3.0]], dtype=torch.float64).repeat(2, 1)
    start = FitState(posed(pose).repeat(2, 1, 1, 1), root, model.shape, *zeros)
    skeleton = pose_skeleton(model, start.rotations, start.root_m)
    world = pose_points(model, skeleton, objective.regressor.points(model, start.landmark_offsets_m)).world_m
    pixels, _ = project(world, observations.camera)
    to_camera = torch.from_numpy(observations.camera.world_to_camera[:3, :3]).double()
    landmarks_3d_m = relative_to_line_of_sight(world, observations.camera) @ to_camera
    observations = replace(observations, landmarks_px=pixels, landmarks_3d_m=landmarks_3d_m)
    prior = objective.pose_prior
    if not with_limits:
        unlimited = torch.full_like(prior.limits.half_range_rad, 10.0)
        prior = replace(prior, limits=replace(prior.limits, half_range_rad=unlimited))
    objective_of_pose = replace(objective, observations=observations, pose_prior=prior)
    return minimise(start, objective_of_pose, objective_of_pose.retract, 12)[0].rotations


@pytest.mark.parametrize("name", OUT_OF_RANGE)
def test_limits_hold_against_infeasible_landmarks(objective: Objective, limits: JointLimits, name: str) -> None:
    joint = ACTIVE_JOINTS.index(name)
    broken, held = (
        float(excess_deg(limits, fitted(objective, {name: OUT_OF_RANGE[name]}, with_limits))[:, joint].max())
        for with_limits in (False, True)
    )
    print(f"{name}: {broken:.1f} degrees beyond without limits, {held:.1f} with them")
    assert broken > 5.0
    assert held < 0.35 * broken


@pytest.mark.parametrize("pose", ["deep squat", "kick to the side", "arm straight up", "looks over the shoulder"])
def test_limits_do_not_change_extreme_feasible_poses(objective: Objective, pose: str) -> None:
    found, free = (fitted(objective, FEASIBLE[pose], with_limits) for with_limits in (True, False))
    assert torch.allclose(found, free, atol=1e-6)
