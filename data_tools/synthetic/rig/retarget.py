"""Carry a motion capture over to another skeleton: bones point where the recorded ones point.

Letters: R_j(t) world rotation of a recorded joint, R_j(0) that of the reference pose, A rotation from the recording's
reference pose to the canonical frame, W rotation from the recording's world to ours, S_j the shortest arc from a bone
of the A-pose to the recorded bone in the reference pose. The joint's world rotation is W R_j(t) R_j(0)^T A^T S_j.
As the reference serves the recorded pose that is most like the A-pose, which keeps the twist of the limbs small.
"""

import numpy as np
import torch
from jaxtyping import Float

from data_tools.synthetic.rig.bvh import Recording
from data_tools.synthetic.rig.directions import shortest_arc
from data_tools.synthetic.scene.motion import above_rest_m
from pipeline.body.body import Body, Motion
from pipeline.core.errors import UserError
from pipeline.geometry.rotation import matrix_to_quaternion

_ALIASES: dict[str, tuple[str, ...]] = {
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
"""Other names of joints. A name counts only where Mixamo's own name of the limb is absent."""

_CHILD: dict[str, str] = {
    "{side}Arm": "{side}ForeArm",
    "{side}ForeArm": "{side}Hand",
    "{side}UpLeg": "{side}Leg",
    "{side}Leg": "{side}Foot",
    **{f"{{side}}Hand{f}{k}": f"{{side}}Hand{f}{k + 1}" for f in ("Index", "Middle", "Ring", "Pinky") for k in (1, 2)},
}
"""Where a limb's bone ends. Skeletons place spine, collar and foot joints differently, so that the direction of those
bones means nothing across them: their S is the identity (a hand's that of the forearm)."""

_NEEDED = ("Hips", "Head", "LeftArm", "RightArm", "LeftForeArm", "RightForeArm", "LeftUpLeg", "RightUpLeg", "LeftLeg")


def retarget(recording: Recording, body: Body, ground_m: Float[np.ndarray, "3"], in_place: bool) -> Motion:
    """The recorded motion on another body, facing +Z in its first frame.

    It stands on the ground in most frames, leaves it in jumps, and is lifted where a foot would sink in.

    Args:
        ground_m: world position under the middle of the path. in_place: drop the motion over the ground.

    Raises:
        UserError: the recording lacks a limb.
    """
    source = matched_joints(recording, body)
    world, positions = recording.poses(recording.rotations)
    reference = _reference_pose(recording, body, source, world, positions)
    motion_to_world = _basis(positions, source).mean(axis=0)
    motion_to_world = _upright(motion_to_world, _basis(positions[:1], source)[0])
    rotations = carried_rotations(body, source, world, reference, motion_to_world)
    local = local_rotations(rotations, body.parents)
    root = _root_path(recording, body, source, motion_to_world, ground_m, in_place)
    count = len(local)
    motion = Motion(
        np.arange(count, dtype=np.int32),
        np.arange(count) / recording.fps,
        local,
        root.astype(np.float32),
    )
    lowest_m = above_rest_m(body, motion)
    standing_m = float(np.percentile(lowest_m, 30.0))
    root[:, 1] += ground_m[1] - standing_m + np.maximum(standing_m - lowest_m, 0.0)
    return motion.with_pose(motion.rotations_wxyz, root)


def matched_joints(recording: Recording, body: Body) -> dict[str, int]:
    """Recorded joint for each of the body's joints that has one.

    Raises:
        UserError: a limb is missing.
    """
    index_of = {name.split(":")[-1].lower(): joint for joint, name in enumerate(recording.joint_names)}
    found: dict[str, int] = {}
    is_mixamo = "leftupleg" in index_of
    aliases = {name: other for side in ("Left", "Right", "") for name, other in _sided(_ALIASES, side).items()}
    for name in body.joint_names:
        candidates = (name,) if is_mixamo else (*aliases.get(name, ()), *(() if name in aliases else (name,)))
        matches = [index_of[candidate.lower()] for candidate in candidates if candidate.lower() in index_of]
        if matches:
            found[name] = matches[0]
    missing = [name for name in _NEEDED if name not in found]
    if missing:
        raise UserError(f"the motion has no joint for {missing[0]}; rename its joints to Mixamo's or CMU's names")
    return found


def resampled(motion: Motion, start_s: float, frame_count: int, fps: float) -> Motion:
    """The nearest recorded pose at each of `frame_count` times from `start_s` on.

    Raises:
        UserError: the recording is too short.
    """
    rows = np.rint((start_s + np.arange(frame_count) / fps) / (motion.time_s[1] - motion.time_s[0])).astype(int)
    if rows[-1] >= len(motion.time_s):
        raise UserError(
            f"the motion ends after {motion.time_s[-1]:.2f} s, {frame_count} frames from {start_s} s on need "
            f"{start_s + (frame_count - 1) / fps:.2f} s; ask for fewer with --frames, or raise --fps"
        )
    chosen = motion.select(rows)
    return Motion(
        np.arange(frame_count, dtype=np.int32),
        np.arange(frame_count) / fps,
        chosen.rotations_wxyz,
        chosen.root_translation_m,
    )


def _sided(table: dict[str, tuple[str, ...]], side: str) -> dict[str, tuple[str, ...]]:
    """The rows of one side, or those without a side."""
    rows = {name: others for name, others in table.items() if ("{side}" in name) == bool(side)}
    return {name.format(side=side): tuple(o.format(side=side) for o in others) for name, others in rows.items()}


def _bones(names: tuple[str, ...], source: dict[str, int]) -> dict[str, str]:
    """Child of each joint whose bone both skeletons have."""
    bones = {
        name.format(side=side): child.format(side=side) for name, child in _CHILD.items() for side in ("Left", "Right")
    }
    return {n: c for n, c in bones.items() if n in source and c in source and n in names and c in names}


def _basis(positions: Float[np.ndarray, "k j 3"], source: dict[str, int]) -> Float[np.ndarray, "k 3 3"]:
    """Rows: the person's left, up and front, in the recording's axes."""
    up = positions[:, source["Head"]] - 0.5 * (positions[:, source["LeftUpLeg"]] + positions[:, source["RightUpLeg"]])
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    left = positions[:, source["LeftUpLeg"]] - positions[:, source["RightUpLeg"]]
    left -= (left * up).sum(axis=1, keepdims=True) * up
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    return np.stack([left, up, np.cross(left, up)], axis=1)


def _upright(mean_basis: Float[np.ndarray, "3 3"], first: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """W: the recording's axis that is up on average becomes +Y, the first frame's front +Z."""
    up = np.zeros(3)
    axis = int(np.abs(mean_basis[1]).argmax())
    up[axis] = np.sign(mean_basis[1, axis])
    front = first[2] - (first[2] @ up) * up
    front /= np.linalg.norm(front)
    return np.stack([np.cross(up, front), up, front])


def _reference_pose(
    recording: Recording, body: Body, source: dict[str, int], world: np.ndarray, positions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """World rotations (j, 3, 3) and canonical bone directions' positions (j, 3) of the pose most like the A-pose.

    Looked at: the file's own rest pose and every tenth frame.
    """
    rest_world, rest_positions = recording.poses(np.tile(np.eye(3), (1, len(recording.parents), 1, 1)))
    worlds, places = np.concatenate([rest_world, world[::10]]), np.concatenate([rest_positions, positions[::10]])
    to_canonical = _basis(places, source)
    places = np.einsum("kab,kjb->kja", to_canonical, places)
    likeness = np.zeros(len(places))
    for name, child in _bones(body.joint_names, source).items():
        bone = body.joints_m[body.joint(child)] - body.joints_m[body.joint(name)]
        recorded = places[:, source[child]] - places[:, source[name]]
        likeness += recorded @ bone / np.maximum(np.linalg.norm(recorded, axis=1) * np.linalg.norm(bone), 1e-9)
    best = int(np.nan_to_num(likeness, nan=-np.inf).argmax())
    return worlds[best].transpose(0, 2, 1) @ to_canonical[best].T, places[best]


def local_rotations(world: Float[np.ndarray, "n j 3 3"], parents: np.ndarray) -> Float[np.ndarray, "n j 4"]:
    """Quaternions (wxyz) of joints relative to their parents."""
    local = world.copy()
    for joint, parent in enumerate(parents):
        if parent >= 0:
            local[:, joint] = world[:, parent].transpose(0, 2, 1) @ world[:, joint]
    return matrix_to_quaternion(torch.from_numpy(local)).numpy().astype(np.float32)


def carried_rotations(
    body: Body,
    source: dict[str, int],
    world: Float[np.ndarray, "n s 3 3"],
    reference: tuple[np.ndarray, np.ndarray],
    motion_to_world: Float[np.ndarray, "3 3"],
) -> Float[np.ndarray, "n j 3 3"]:
    """World rotation of each of the body's joints; joints without a recorded one follow their parent.

    source: row of `world` for each joint that has one. reference: what undoes the reference pose's rotations, and where
    the recorded joints lie in it, canonical axes.
    """
    undo, places = reference
    bones = _bones(body.joint_names, source)
    rotations = np.tile(np.eye(3), (len(world), len(body.joint_names), 1, 1))
    arcs = np.tile(np.eye(3), (len(body.joint_names), 1, 1))
    for joint, (name, parent) in enumerate(zip(body.joint_names, body.parents, strict=True)):
        if name in bones:
            bone = body.joints_m[body.joint(bones[name])] - body.joints_m[joint]
            recorded = places[source[bones[name]]] - places[source[name]]
            arcs[joint] = shortest_arc(torch.from_numpy(bone).double(), torch.from_numpy(recorded)).numpy()
        elif "Hand" in name:
            arcs[joint] = arcs[parent]
        if name in source:
            rotations[:, joint] = motion_to_world @ world[:, source[name]] @ undo[source[name]] @ arcs[joint]
        else:
            rotations[:, joint] = rotations[:, parent]
    return rotations


def _root_path(
    recording: Recording,
    body: Body,
    source: dict[str, int],
    motion_to_world: Float[np.ndarray, "3 3"],
    ground_m: Float[np.ndarray, "3"],
    in_place: bool,
) -> Float[np.ndarray, "n 3"]:
    """Position of the hips in metres, scaled by the length of the legs; its height is settled afterwards."""
    joints_m = body.joints_m
    leg_m = sum(
        np.linalg.norm(joints_m[body.joint(f"Left{b}")] - joints_m[body.joint(f"Left{a}")])
        for a, b in (("UpLeg", "Leg"), ("Leg", "Foot"))
    )
    recorded = sum(np.linalg.norm(recording.offsets[source[f"Left{name}"]]) for name in ("Leg", "Foot"))
    path = recording.root_positions @ motion_to_world.T * (leg_m / recorded)
    middle = 0.5 * (path.min(axis=0) + path.max(axis=0))
    path[:, [0, 2]] += ground_m[[0, 2]] - (path[:, [0, 2]] if in_place else middle[[0, 2]])
    return path
