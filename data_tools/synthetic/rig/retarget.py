"""Retarget motion capture to another skeleton so that bones have the directions of the recorded bones.

Notation: R_j(t) world rotation of a recorded joint, R_j(0) that of the reference pose, A rotation from the reference
pose to the canonical frame, W rotation from the BVH world to the world, S_j the shortest arc from a bone of the A-pose
to the recorded bone in the reference pose. The world rotation of the joint is W R_j(t) R_j(0)^T A^T S_j. The reference
is the recorded pose most similar to the A-pose, which keeps the twist of the limbs small.
"""

import numpy as np
import torch
from jaxtyping import Float

from data_tools.synthetic.rig.bvh import BvhMotion
from data_tools.synthetic.scene.motion import lowest_foot_offset_m
from pipeline.body.body import Body, Motion
from pipeline.core.errors import UserError
from pipeline.geometry.rotation import matrix_to_quaternion, rotation_between

_JOINT_ALIASES: dict[str, tuple[str, ...]] = {
    "Spine": ("lowerback", "Chest"),
    "Spine1": ("Chest",),
    "Spine2": ("Chest2", "Spine3"),
    "{side}Shoulder": ("{side}Collar",),
    "{side}Arm": ("{side}Shoulder",),
    "{side}ForeArm": ("{side}Elbow",),
    "{side}Hand": ("{side}Wrist",),
    "{side}UpLeg": ("{side}Hip", "{side}Thigh"),
    "{side}Leg": ("{side}Knee", "{side}Shin"),
    "{side}Foot": ("{side}Ankle",),
    "{side}ToeBase": ("{side}Toe",),
}
"""Alternative joint names, used only for skeletons without Mixamo names."""

_BONE_CHILD: dict[str, str] = {
    "{side}Arm": "{side}ForeArm",
    "{side}ForeArm": "{side}Hand",
    "{side}UpLeg": "{side}Leg",
    "{side}Leg": "{side}Foot",
    **{f"{{side}}Hand{f}{k}": f"{{side}}Hand{f}{k + 1}" for f in ("Index", "Middle", "Ring", "Pinky") for k in (1, 2)},
}
"""Child joint at the end of the bone of a limb. Positions of spine, collar and foot joints differ between skeletons, so
the directions of those bones are not comparable: their S is the identity (S of the forearm for a hand)."""

_REQUIRED_JOINTS = (
    "Hips",
    "Head",
    "LeftArm",
    "RightArm",
    "LeftForeArm",
    "RightForeArm",
    "LeftUpLeg",
    "RightUpLeg",
    "LeftLeg",
)


def retarget(bvh_motion: BvhMotion, body: Body, ground_m: Float[np.ndarray, "3"], in_place: bool) -> Motion:
    """Retarget the recorded motion to another body, which faces +Z in the first frame.

    The 30th percentile of the lowest foot height is on the ground; frames with a lower foot are raised to the ground.

    Args:
        ground_m: world position below the middle of the trajectory.
        in_place: remove the horizontal root translation.

    Raises:
        UserError: the motion lacks a required joint.
    """
    recorded_joint_of = match_joints(bvh_motion, body)
    world, positions = bvh_motion.forward_kinematics(bvh_motion.rotations)
    reference = _reference_pose(bvh_motion, body, recorded_joint_of, world, positions)
    bvh_to_world = _body_axes(positions, recorded_joint_of).mean(axis=0)
    bvh_to_world = _bvh_to_world(bvh_to_world, _body_axes(positions[:1], recorded_joint_of)[0])
    rotations = retarget_rotations(body, recorded_joint_of, world, reference, bvh_to_world)
    local = local_quaternions(rotations, body.parents)
    root = _root_trajectory(bvh_motion, body, recorded_joint_of, bvh_to_world, ground_m, in_place)
    count = len(local)
    motion = Motion(
        np.arange(count, dtype=np.int32),
        np.arange(count) / bvh_motion.fps,
        local,
        root.astype(np.float32),
    )
    lowest_foot_height_m = lowest_foot_offset_m(body, motion)
    standing_height_m = float(np.percentile(lowest_foot_height_m, 30.0))
    root[:, 1] += ground_m[1] - standing_height_m + np.maximum(standing_height_m - lowest_foot_height_m, 0.0)
    return motion.with_pose(motion.rotations_wxyz, root)


def match_joints(bvh_motion: BvhMotion, body: Body) -> dict[str, int]:
    """Return the index of the recorded joint by name of the body's joint, for joints that have one.

    Raises:
        UserError: a required joint is missing.
    """
    index_of = {name.split(":")[-1].lower(): joint for joint, name in enumerate(bvh_motion.joint_names)}
    found: dict[str, int] = {}
    is_mixamo = "leftupleg" in index_of
    aliases = {
        name: other for side in ("Left", "Right", "") for name, other in _expand_side(_JOINT_ALIASES, side).items()
    }
    for name in body.joint_names:
        candidates = (name,) if is_mixamo else (*aliases.get(name, ()), *(() if name in aliases else (name,)))
        matches = [index_of[candidate.lower()] for candidate in candidates if candidate.lower() in index_of]
        if matches:
            found[name] = matches[0]
    missing = [name for name in _REQUIRED_JOINTS if name not in found]
    if missing:
        raise UserError(f"the motion has no joint for {missing[0]}; rename its joints to the Mixamo or CMU names")
    return found


def resample_motion(motion: Motion, start_s: float, frame_count: int, fps: float) -> Motion:
    """Select the nearest recorded pose at each of `frame_count` times from `start_s`.

    Raises:
        UserError: the motion is too short.
    """
    rows = np.rint((start_s + np.arange(frame_count) / fps) / (motion.time_s[1] - motion.time_s[0])).astype(int)
    if rows[-1] >= len(motion.time_s):
        raise UserError(
            f"the motion ends at {motion.time_s[-1]:.2f} s, but {frame_count} frames from {start_s} s need "
            f"{start_s + (frame_count - 1) / fps:.2f} s; reduce --frames or increase --fps"
        )
    chosen = motion.select(rows)
    return Motion(
        np.arange(frame_count, dtype=np.int32),
        np.arange(frame_count) / fps,
        chosen.rotations_wxyz,
        chosen.root_translation_m,
    )


def _expand_side(table: dict[str, tuple[str, ...]], side: str) -> dict[str, tuple[str, ...]]:
    """Return the rows of a table for one side; for the empty side, the rows without a side."""
    rows = {name: others for name, others in table.items() if ("{side}" in name) == bool(side)}
    return {name.format(side=side): tuple(o.format(side=side) for o in others) for name, others in rows.items()}


def _common_bones(names: tuple[str, ...], recorded_joint_of: dict[str, int]) -> dict[str, str]:
    """Return the child joint of each bone that both skeletons have."""
    bones = {
        name.format(side=side): child.format(side=side)
        for name, child in _BONE_CHILD.items()
        for side in ("Left", "Right")
    }
    return {
        n: c
        for n, c in bones.items()
        if n in recorded_joint_of and c in recorded_joint_of and n in names and c in names
    }


def _body_axes(positions: Float[np.ndarray, "k j 3"], recorded_joint_of: dict[str, int]) -> Float[np.ndarray, "k 3 3"]:
    """Return rotations from BVH axes to the axes of the body; rows are left, up and front of the person."""
    up = positions[:, recorded_joint_of["Head"]] - 0.5 * (
        positions[:, recorded_joint_of["LeftUpLeg"]] + positions[:, recorded_joint_of["RightUpLeg"]]
    )
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    left = positions[:, recorded_joint_of["LeftUpLeg"]] - positions[:, recorded_joint_of["RightUpLeg"]]
    left -= (left * up).sum(axis=1, keepdims=True) * up
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    return np.stack([left, up, np.cross(left, up)], axis=1)


def _bvh_to_world(mean_basis: Float[np.ndarray, "3 3"], first: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """Return W: it maps the mean up axis of the recording to +Y and the front of the first frame to +Z."""
    up = np.zeros(3)
    axis = int(np.abs(mean_basis[1]).argmax())
    up[axis] = np.sign(mean_basis[1, axis])
    front = first[2] - (first[2] @ up) * up
    front /= np.linalg.norm(front)
    return np.stack([np.cross(up, front), up, front])


def _reference_pose(
    bvh_motion: BvhMotion, body: Body, recorded_joint_of: dict[str, int], world: np.ndarray, positions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return R(0)^T A^T (j, 3, 3) and canonical joint positions (j, 3) of the pose most similar to the A-pose.

    Candidates are the rest pose of the file and every tenth frame.
    """
    rest_world, rest_positions = bvh_motion.forward_kinematics(np.tile(np.eye(3), (1, len(bvh_motion.parents), 1, 1)))
    worlds, canonical_positions = (
        np.concatenate([rest_world, world[::10]]),
        np.concatenate([rest_positions, positions[::10]]),
    )
    to_canonical = _body_axes(canonical_positions, recorded_joint_of)
    canonical_positions = np.einsum("kab,kjb->kja", to_canonical, canonical_positions)
    pose_similarity = np.zeros(len(canonical_positions))
    for name, child in _common_bones(body.joint_names, recorded_joint_of).items():
        bone = body.joints_m[body.joint(child)] - body.joints_m[body.joint(name)]
        recorded = canonical_positions[:, recorded_joint_of[child]] - canonical_positions[:, recorded_joint_of[name]]
        pose_similarity += recorded @ bone / np.maximum(np.linalg.norm(recorded, axis=1) * np.linalg.norm(bone), 1e-9)
    best = int(np.nan_to_num(pose_similarity, nan=-np.inf).argmax())
    return worlds[best].transpose(0, 2, 1) @ to_canonical[best].T, canonical_positions[best]


def local_quaternions(world: Float[np.ndarray, "n j 3 3"], parents: np.ndarray) -> Float[np.ndarray, "n j 4"]:
    """Return quaternions (wxyz) of joints relative to their parents."""
    local = world.copy()
    for joint, parent in enumerate(parents):
        if parent >= 0:
            local[:, joint] = world[:, parent].transpose(0, 2, 1) @ world[:, joint]
    return matrix_to_quaternion(torch.from_numpy(local)).numpy().astype(np.float32)


def retarget_rotations(
    body: Body,
    recorded_joint_of: dict[str, int],
    world: Float[np.ndarray, "n s 3 3"],
    reference: tuple[np.ndarray, np.ndarray],
    bvh_to_world: Float[np.ndarray, "3 3"],
) -> Float[np.ndarray, "n j 3 3"]:
    """Return the world rotation of each joint of the body; joints without a recorded joint follow their parent.

    Args:
        recorded_joint_of: column of `world` by name of the body's joint.
        world: world rotations of the recorded joints.
        reference: inverse rotations of the reference pose, and its joint positions in canonical axes.
    """
    inverse_reference, canonical_positions = reference
    bones = _common_bones(body.joint_names, recorded_joint_of)
    rotations = np.tile(np.eye(3), (len(world), len(body.joint_names), 1, 1))
    arcs = np.tile(np.eye(3), (len(body.joint_names), 1, 1))
    for joint, (name, parent) in enumerate(zip(body.joint_names, body.parents, strict=True)):
        if name in bones:
            bone = body.joints_m[body.joint(bones[name])] - body.joints_m[joint]
            recorded = (
                canonical_positions[recorded_joint_of[bones[name]]] - canonical_positions[recorded_joint_of[name]]
            )
            arcs[joint] = rotation_between(torch.from_numpy(bone).double(), torch.from_numpy(recorded)).numpy()
        elif "Hand" in name:
            arcs[joint] = arcs[parent]
        if name in recorded_joint_of:
            rotations[:, joint] = (
                bvh_to_world
                @ world[:, recorded_joint_of[name]]
                @ inverse_reference[recorded_joint_of[name]]
                @ arcs[joint]
            )
        else:
            rotations[:, joint] = rotations[:, parent]
    return rotations


def _root_trajectory(
    bvh_motion: BvhMotion,
    body: Body,
    recorded_joint_of: dict[str, int],
    bvh_to_world: Float[np.ndarray, "3 3"],
    ground_m: Float[np.ndarray, "3"],
    in_place: bool,
) -> Float[np.ndarray, "n 3"]:
    """Return the hip positions in metres, scaled by the ratio of leg lengths; the caller sets the height."""
    joints_m = body.joints_m
    leg_m = sum(
        np.linalg.norm(joints_m[body.joint(f"Left{b}")] - joints_m[body.joint(f"Left{a}")])
        for a, b in (("UpLeg", "Leg"), ("Leg", "Foot"))
    )
    recorded = sum(np.linalg.norm(bvh_motion.offsets[recorded_joint_of[f"Left{name}"]]) for name in ("Leg", "Foot"))
    trajectory = bvh_motion.root_positions @ bvh_to_world.T * (leg_m / recorded)
    middle = 0.5 * (trajectory.min(axis=0) + trajectory.max(axis=0))
    trajectory[:, [0, 2]] += ground_m[[0, 2]] - (trajectory[:, [0, 2]] if in_place else middle[[0, 2]])
    return trajectory
